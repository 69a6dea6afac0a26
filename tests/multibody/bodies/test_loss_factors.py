"""Loss factors of plies: damping ratios of plates by the strain energies of their plies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from torchmbd.design.differentiate import differentiate

MODULI: dict[str, Any] = {"E1": 60e9, "E2": 9e9, "G12": 5e9, "G13": 4e9, "G23": 3e9, "nu12": 0.3, "density": 1600.0}
LOSSES = (0.02, 0.3, 0.05)


def plate(losses=LOSSES, factors=(1.0, 1.0, 1.0), modes: int = 4, thickness: float = 2e-4) -> mbd.FlexibleBody:
    """Three different, slanted layers, the middle one softer; `factors` multiply all moduli of a ply."""
    plies = []
    for loss, factor, soft in zip(losses, factors, (1.0, 0.3, 0.8), strict=True):
        moduli: dict[str, Any] = {name: x * (factor * soft if name[0] in "EG" else 1.0) for name, x in MODULI.items()}
        plies.append(mbd.Ply(**moduli, loss=loss))
    laminate = mbd.Laminate(plies, mbd.deg([20.0, -50.0, 75.0]), [0.2 * thickness, 0.55 * thickness, 0.25 * thickness])
    mesh = mbd.mesh.rectangle(length=0.4, width=0.1, cells=(6, 2))
    return mbd.FlexibleBody.plate("plate", mesh, laminate, modes=modes, reference="left")


def clamped(body: mbd.FlexibleBody) -> mbd.System:
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("left"), name="clamp")])


@pytest.mark.extensions
def test_equal_losses_of_all_plies():
    """Half of it is the damping ratio of every mode."""
    rest = mbd.equilibrium(clamped(plate((0.04, 0.04, 0.04))))
    np.testing.assert_allclose(rest.damping_ratios[0].numpy(force=True), 0.02, rtol=1e-9)


@pytest.mark.extensions
@pytest.mark.thorough
@pytest.mark.parametrize("thickness", [2e-4, 2e-3, 1e-2])
def test_shares_of_the_strain_energy(thickness):
    """eta_i U_i / U, by how w^2 grows with the moduli of ply i: d ln w^2 / d ln E_i = U_i / U of a mode."""
    losses = tuple(1e-2 * x for x in LOSSES)  # so small that modes do not couple by them
    ratios = mbd.equilibrium(clamped(plate(losses, thickness=thickness))).damping_ratios[0].numpy(force=True)
    h, expected = 1e-4, np.zeros(4)
    for i, loss in enumerate(losses):
        ends = []
        for sign in (-1.0, 1.0):
            factors = [1.0 + sign * h if k == i else 1.0 for k in range(3)]
            ends.append(
                mbd.natural_frequencies(plate(factors=factors, thickness=thickness), None, 4).frequencies.numpy(
                    force=True
                )
            )
        shares = np.log(ends[1] / ends[0]) / h  # of w^2, over 2 h
        expected += 0.5 * loss * shares
    np.testing.assert_allclose(ratios, expected, rtol=1e-5)  # of frequencies 1e-10 over h
    assert np.ptp(expected) > 3e-5


@pytest.mark.extensions
@pytest.mark.thorough
@pytest.mark.parametrize("name", ["plate.laminate.ply1.loss", "plate.laminate.angles", "plate.laminate.thickness"])
def test_derivatives_are_those_of_differences(name):
    body = plate((0.02, mbd.variable(0.3), 0.05))
    system = clamped(body)
    x = dict(system.named_parameters())[name].detach()[None]

    def ratios(y: torch.Tensor) -> torch.Tensor:
        return mbd.equilibrium(system, designs={name: y}, variables=[name]).damping_ratios

    leaf = x.clone().requires_grad_()
    weights = torch.tensor([1.0, -2.0, 0.5, 3.0], dtype=torch.float64)
    [slope] = torch.autograd.grad((ratios(leaf) * weights).sum(), leaf)
    direction = torch.ones_like(x) if name.endswith("angles") else x
    h = 1e-3
    with torch.no_grad():
        at = [(ratios(x + k * h * direction) * weights).sum() for k in (-2, -1, 1, 2)]
    expected = (8.0 * (at[2] - at[1]) - (at[3] - at[0])) / (12.0 * h)
    assert float((slope * direction).sum()) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.thorough
def test_forward_mode_of_a_motion_is_reverse_mode():
    body = plate((0.02, mbd.variable(0.3), 0.05), modes=2)
    clamp = mbd.Fixed(mbd.Ground().at(), body.at("left"), name="clamp")
    system = mbd.System([body], [clamp], gravity=(0.0, 0.0, -9.81))
    names = ["plate.laminate.ply1.loss", "plate.laminate.angles"]
    slopes = []
    for mode in ("forward", "reverse"):
        motion = mbd.simulate(system, 0.05, steps=40, gradients=mode, variables=names)
        slopes.append(differentiate(mbd.Max(mbd.StrainEnergy("plate")), motion).gradient)
    torch.testing.assert_close(*slopes, rtol=1e-8, atol=0.0)


@pytest.mark.extensions
@pytest.mark.thorough
def test_fibers_that_steer():
    """Each cell has a law of its own; equal losses are those of every mode."""
    ply, mesh = mbd.Ply(**MODULI, loss=0.04), mbd.mesh.rectangle(length=0.4, width=0.1, cells=(6, 2))
    field = mbd.fibers.FiberField(mesh, controls=(3, 1))
    steered = mbd.fibers.SteeredLaminate(
        ply, mbd.deg(torch.tensor([[10.0, 5.0], [50.0, 0.0], [80.0, 20.0]])), 1e-3, field
    )
    body = mbd.FlexibleBody.plate("plate", mesh, steered, modes=3, reference="left")
    np.testing.assert_allclose(mbd.equilibrium(clamped(body)).damping_ratios[0].numpy(force=True), 0.02, rtol=1e-9)


@pytest.mark.extensions
@pytest.mark.thorough
@pytest.mark.extensions
def test_a_loss_factor_is_identified():
    """Of the soft layer, by the damping ratios of a twin."""
    truth = mbd.equilibrium(clamped(plate()))
    data = mbd.identification.ModalData(truth.frequencies[0].detach(), truth.damping_ratios[0].detach())
    start = clamped(plate((0.02, mbd.variable(0.1), 0.05)))
    fit = mbd.identification.identify(mbd.identification.Experiment(start, data), ["plate.laminate.ply1.loss"])
    assert fit["plate.laminate.ply1.loss"] == pytest.approx(0.3, rel=1e-6)


@pytest.mark.extensions
def test_what_has_no_loss_is_refused():
    ply = mbd.Ply(**MODULI, loss=0.01)
    with refused("loss", -0.1):
        mbd.Ply(**MODULI, loss=-0.1)
    with refused("ply"):
        mbd.sections.strip(0.03, ply, mbd.deg([0.0]), 1e-3)
    with refused("ply"):
        mbd.lamination.LaminationParameters(ply, [0.0] * 4, [0.0] * 4, 1e-3)
