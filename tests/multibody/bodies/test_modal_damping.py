"""Modal damping ratios: poles of a welded plate, derivatives where frequencies meet, a motion's gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum, plate
from tests.refused import refused
from torchmbd.multibody.bodies.modal_damping import ModalDamping

RATIOS = (0.02, 0.05, 0.003)


@pytest.mark.thorough
def test_poles_of_a_welded_plate():
    """A plate fixed where its frame is has the poles - z om +- i om (1 - z^2)^1/2."""
    body = plate("panel", modes=3, reference="left").damped(RATIOS)
    om = torch.linalg.eigvalsh(body.structure()["Kr"].detach()).sqrt()
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(-0.15, 0.0, 0.0), body.at("left"))])
    poles = mbd.equilibrium(system).vibrations[0].poles
    z = torch.tensor(RATIOS, dtype=torch.float64)
    expected = torch.complex(-z * om, om * (1.0 - z * z).sqrt())
    result = poles[poles.imag > 0]
    assert_close(result[result.imag.argsort()], expected, rtol=1e-9, atol=0)


def stiffness(b: torch.Tensor) -> torch.Tensor:
    """Frequencies 2 and 3 meet at b = 0."""
    V = torch.linalg.matrix_exp(
        torch.stack([torch.stack(x) for x in ((0 * b, b, -2 * b), (-b, 0 * b, b), (2 * b, -b, 0 * b))])
    )
    zero = torch.zeros_like(b)
    middle = torch.stack(
        [torch.stack([1 + b, zero, zero]), torch.stack([zero, 4 + b, zero]), torch.stack([zero, zero, 4 - b])]
    )
    return V @ middle @ V.mT


@pytest.mark.parametrize(("ratios", "b"), [(RATIOS, 0.3), ((0.04, 0.02, 0.02), 0.0), ((0.1, 0.1, 0.1), 0.0)])
def test_derivatives_against_differences(ratios, b):
    damping, at = ModalDamping("body", 0.01).with_ratios(ratios, range(3, 4)), torch.tensor(b, dtype=torch.float64)

    def D(x: torch.Tensor) -> torch.Tensor:
        result = damping.matrix(stiffness(x))
        assert result is not None
        return result

    h = 1e-4
    expected = (8 * (D(at + h) - D(at - h)) - D(at + 2 * h) + D(at - 2 * h)) / (12 * h)
    for jacobian in (torch.func.jacfwd, torch.func.jacrev):
        assert_close(jacobian(D)(at), expected, rtol=1e-9, atol=1e-10)
    if ratios == (0.1, 0.1, 0.1):
        K = stiffness(at + 0.2)
        root = torch.from_numpy(np.real(sqrtm(K.numpy())))
        assert_close(D(at + 0.2), 0.01 * K + 0.2 * root, rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
def test_gradients_of_a_damped_motion():
    system = pendulum()
    system.body("rod").damped((0.05, 0.1))
    energy, name = mbd.Integral(mbd.StrainEnergy("rod")), "rod.laminate.angles"
    angles = system.body("rod").laminate.angles.detach()
    h = 1e-5
    designs = {
        name: torch.stack([angles, *(angles + s * h * e for s in (1, -1) for e in torch.eye(2, dtype=torch.float64))])
    }
    options = {"steps": 60, "iterations": (5, 4)}
    motion = mbd.simulate(system, 0.03, designs=designs, gradients="forward", variables=[name], **options).require_ok()
    value, gradient = energy.value_and_gradient(motion)
    assert_close(gradient[0], (value[1:3] - value[3:]) / (2 * h), rtol=1e-5, atol=0)
    energies = motion.energies
    assert float(energies.dissipated[0, -1]) > 0.1 * float(energies.strain.max())
    assert float(energies.balance.abs().max()) < 5e-3 * float(energies.kinetic.max())


@pytest.mark.thorough
def test_bad_ratios_are_named():
    body = plate("panel", modes=3)
    for wrong in ((0.1, 0.2), 1.5, (0.1, -0.1, 0.1), (0.1, float("nan"), 0.1)):
        with refused("panel.damping.ratio"):
            body.damped(wrong)
