"""Progressive failure: cross-plies and strips in closed form, order of steps, gradients, refusals."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from tests.refused import refused

STRENGTH = mbd.Strength(Xt=1.5e9, Xc=1.2e9, Yt=40e6, Yc=246e6, S12=68e6)
PLY = mbd.Ply(181e9, 10.3e9, 7.17e9, 7.17e9, 7.17e9, 0.28, 1600.0, strength=STRENGTH)
T = 1e-3


def cross(angles=(0.0, 90.0, 0.0)) -> mbd.Laminate:
    return mbd.Laminate(PLY, mbd.deg(list(angles)), T)


def seen(steps) -> list[tuple[list[int], str]]:
    return [(step.layers, step.mode) for step in steps]


@pytest.mark.parametrize("criterion", ["max_stress", "hashin", "puck"])
def test_cross_ply_in_tension(criterion):
    """First the 90 degree ply by its transverse stress; in the end the fibers of the others bear Xt each, alone."""
    laminate = cross()
    steps = mbd.progressive_failure(laminate, (1e6, 0, 0), criterion=criterion)
    A = laminate.stiffness().A.detach()
    eps = torch.linalg.solve(A, torch.tensor([1e6, 0, 0], dtype=torch.float64))
    Q = torch.linalg.inv(torch.tensor([[1 / 181e9, -0.28 / 181e9], [-0.28 / 181e9, 1 / 10.3e9]], dtype=torch.float64))
    across = (Q @ eps[[1, 0]])[1]  # the fibers of the middle ply lie along y
    assert steps[0].layers == [1]
    assert steps[0].load.item() == pytest.approx(40e6 / float(across), rel=1e-9)
    if criterion != "puck":
        assert steps[0].mode == "matrix tension"
    assert steps[-1].load.item() == pytest.approx(2 * T * 1.5e9 / 1e6, rel=1e-3)
    loads = [step.load.item() for step in steps]
    assert loads == sorted(loads)


def test_bending_breaks_the_side_that_is_pressed():
    """A single ply: Xc < Xt, M = Xc t^2 / 6."""
    steps = mbd.progressive_failure(cross([0.0]), moment=(1.0, 0, 0), criterion="max_stress")
    assert seen(steps) == [([0], "fiber compression")]
    assert steps[0].load.item() == pytest.approx(1.2e9 * T**2 / 6, rel=1e-9)


def test_the_sign_of_the_load_counts():
    pushed = mbd.progressive_failure(cross(), (-1e6, 0, 0), criterion="max_stress")
    assert "fiber compression" in [step.mode for step in pushed]
    assert pushed[-1].load.item() == pytest.approx(2 * T * 1.2e9 / 1e6, rel=5e-2)


def test_symmetric_layers_fail_together():
    steps = mbd.progressive_failure(cross([45, -45, 0, 90, 90, 0, -45, 45]), (1e6, 2e5, 0), criterion="hashin")
    assert all(sorted(7 - k for k in step.layers) == step.layers for step in steps)
    assert steps[0].layers == [3, 4]


@pytest.mark.thorough
@pytest.mark.parametrize("step", [0, 1])
def test_gradients_against_differences(step):
    angles = torch.as_tensor(mbd.deg([10.0, 80.0, -15.0]))

    def load(x: torch.Tensor) -> torch.Tensor:
        laminate = mbd.Laminate(PLY, x, T)
        return mbd.progressive_failure(laminate, (1e6, 1e5, 2e4), (5.0, 0, 1.0))[step].load

    parameter = torch.nn.Parameter(angles.clone())
    load(parameter).backward()
    assert parameter.grad is not None
    h = 1e-5
    for k in range(3):
        change = torch.zeros(3, dtype=torch.float64)
        change[k] = h
        expected = float(load(angles + change) - load(angles - change)) / (2 * h)
        assert float(parameter.grad[k]) == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rounding_does_not_choose_the_mode(sign):
    """In pure shear the stress along fibers at 0 and 90 degrees is zero, and Hashin's modes of fiber and matrix are equal.

    Both signs of the shear are mirror images.
    """
    steps = mbd.progressive_failure(cross([0, 90, 45, -45, -45, 45, 90, 0]), (0, 0, sign * 1e6), criterion="hashin")
    pulled, pressed = ([2, 5], [3, 4]) if sign > 0 else ([3, 4], [2, 5])
    assert seen(steps)[:2] == [([0, 1, 6, 7], "matrix tension"), (pressed, "matrix tension")]
    assert {tuple(step.layers): step.mode for step in steps[2:]} == {
        tuple(pulled): "fiber tension",
        tuple(pressed): "fiber compression",
    }


def test_stresses_of_rounding_break_nothing():
    """Shear of a cross-ply whose matrix holds all shear: what remains along the fibers is rounding."""
    strength = mbd.Strength(Xt=1.5e9, Xc=1.2e9, Yt=40e6, Yc=246e6, S12=float("inf"))
    ply = mbd.Ply(181e9, 10.3e9, 7.17e9, 7.17e9, 7.17e9, 0.28, 1600.0, strength=strength)
    laminate = mbd.Laminate(ply, mbd.deg([0, 90, 0]), T)
    assert mbd.progressive_failure(laminate, (0, 0, 1e6), criterion="max_stress") == []
    with refused("criterion", "puck"):
        mbd.progressive_failure(laminate, (0, 0, 1e6), criterion="puck")


@pytest.mark.thorough
def test_gradients_by_forces():
    """Loads are homogeneous of degree -1 in the forces (Euler)."""
    force = torch.tensor([1e6, 2e5, -1e5], dtype=torch.float64, requires_grad=True)
    moment = torch.tensor([5.0, 0.0, 1.0], requires_grad=True)
    first = mbd.progressive_failure(cross([0, 90, 30]), force, moment)[0].load
    by = torch.autograd.grad(first, [force, moment])
    assert float(by[0] @ force + by[1].double() @ moment.double()) == pytest.approx(-float(first), rel=1e-6)


def test_bad_input_is_named():
    bare = mbd.Laminate(mbd.Ply.isotropic(70e9, 0.3, 2700.0), [0.0], T)
    with pytest.raises(mbd.InputError) as error:
        mbd.progressive_failure(cross(), (1, 0, 0), criterion="tsai_wu")
    assert (error.value.path, error.value.value) == (("criterion",), "tsai_wu")
    with refused("force"):
        mbd.progressive_failure(cross())
    with pytest.raises(mbd.InputError) as error:
        mbd.progressive_failure(cross(), (1.0, 2.0))
    assert (error.value.path, error.value.value) == (("force",), [1.0, 2.0])
    with pytest.raises(mbd.InputError) as error:
        mbd.progressive_failure(cross(), (1, 0, 0), kept=0)
    assert (error.value.path, error.value.value) == (("kept",), 0)
    with refused("laminate"):
        mbd.progressive_failure(bare, (1, 0, 0))


@pytest.mark.extensions
def test_lamination_parameters_have_no_plies_that_fail():
    with refused("laminate"):
        mbd.progressive_failure(mbd.lamination.LaminationParameters(PLY, T, [0, 0, 0, 0]), (1, 0, 0))
