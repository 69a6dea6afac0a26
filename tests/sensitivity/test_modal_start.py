"""Gradients of motions that start with modal coordinates: numbers in the modes of each design, not in a basis that moves."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import CARBON, SOFT, laminate, plate, tensor
from tests.refused import refused
from tests.sensitivity.number_cases import check, check_native, differences, hung, number, ply

W, RATE = tensor(1e-3, -4e-4, 2e-4), tensor(0.1, 0.2, -0.3)
ANGLES = "rod.laminate.angles"
CRAIG_BAMPTON = {"reduction": "craig-bampton", "interface": "right"}


def rod(modes: int = 3, **options) -> mbd.FlexibleBody:
    return plate("rod", modes, made_of=laminate((20.0, -50.0), 3e-3, SOFT), **options)


@pytest.mark.thorough
@pytest.mark.parametrize("rate", [None, RATE])
def test_gradients_of_a_bent_start(rate):
    check(hung(rod().bent(W, rate)), [ANGLES])


@pytest.mark.thorough
def test_gradients_of_a_bent_start_of_both_reductions_and_backends(native):
    check_native(hung(rod().bent(W, RATE)), [ANGLES])
    body = rod(2, **CRAIG_BAMPTON)
    check(hung(body.bent(1e-3 * torch.cos(torch.arange(body.modes, dtype=torch.float64)))), [ANGLES])


@pytest.mark.thorough
def test_gradients_of_a_start_by_numbers():
    """One for all designs, and one for each."""
    check(hung(rod()), [ANGLES], partial(number, start={"rod.modal": W, "rod.modal_velocity": RATE}))
    system, start = hung(rod()), {"rod.modal": torch.stack([W, -2.0 * W])}
    x = system.get_parameter(ANGLES).detach().repeat(2, 1).requires_grad_()
    (both,) = torch.autograd.grad(number(system, {ANGLES: x}, start=start).sum(), x)
    for lane, w in enumerate(start["rod.modal"]):
        (alone,) = torch.autograd.grad(number(system, {ANGLES: x[:1]}, start={"rod.modal": w}).sum(), x)
        assert_close(both[lane], alone[0], rtol=1e-8, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["reverse", "forward"])
def test_the_energy_at_the_start_is_that_of_single_modes(gradients):
    """sum lambda_i w_i^2 / 2, whose derivative is that of the eigenvalues."""
    system = hung(rod().bent(W))
    x = system.get_parameter(ANGLES).detach()[None].clone().requires_grad_()
    energy = mbd.AtTime(mbd.StrainEnergy("rod"), 0.0)
    result = energy(mbd.simulate(system, 1e-3, steps=2, designs={ANGLES: x}, gradients=gradients))
    (by,) = torch.autograd.grad(result.sum(), x)
    values = torch.linalg.eigvalsh(system.body("rod").structure()["Kr"])
    (expected,) = torch.autograd.grad(0.5 * values @ W**2, system.get_parameter(ANGLES))
    assert_close(by[0], expected, rtol=1e-9, atol=0)


@pytest.mark.thorough
def test_a_motion_that_starts_where_another_ends():
    """Of numbers, and of a function of the same design; both are what differences of the two motions say."""
    system = hung(rod().bent(W))
    x = system.get_parameter(ANGLES).detach()[None].clone().requires_grad_()
    first = partial(mbd.simulate, system, 0.02, steps=6, iterations=(8, 4))
    fixed = first(gradients="none")

    def both(system: mbd.System, designs: dict[str, Tensor], **options) -> Tensor:
        return number(system, designs, start=first(designs=designs), **options)

    for f in (partial(number, start=fixed), both):
        (by,) = torch.autograd.grad(f(system, {ANGLES: x}).sum(), x)
        expected = differences(partial(f, system), system, [ANGLES])[ANGLES]
        assert_close(by[0], expected, rtol=0, atol=1e-6 * float(by.abs().max()))


@pytest.mark.thorough
def test_modes_of_equal_frequency_have_no_gradient():
    """Bending of a round tube in two planes; where they are at rest, the others have one."""
    tube = mbd.sections.tube(radius=0.02, ply=ply(1.0, **CARBON), angles=mbd.deg([20.0, -20.0]), thickness=1e-3)
    line = mbd.BeamLine.straight(length=1.0, elements=4)

    def energy(w: Tensor) -> Tensor:
        beam = mbd.FlexibleBody.beam("beam", line, tube, modes=2, reference="start").bent(w)
        system = mbd.System([beam], [mbd.Fixed(mbd.Ground().at(), beam.at("start"))])
        return mbd.AtTime(mbd.StrainEnergy("beam"), 0.0)(mbd.simulate(system, 1e-4, steps=2))

    with refused("start.beam"):
        energy(tensor(1e-3, 0.0))
    assert energy(tensor(0.0, 0.0)).requires_grad
    with torch.no_grad():
        assert energy(tensor(1e-3, 0.0)) > 0.0
