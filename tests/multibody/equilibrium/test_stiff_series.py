"""Vibrations of soft springs in series with stiff ones, in closed form and against rigid joints: any ratio of stiffnesses."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import INERTIA, turned
from tests.refused import refused

pytestmark = pytest.mark.extensions  # eigenvalues of equilibria
GROUND, AXES = mbd.Ground(), turned(0.4, -0.7, 0.3)
RATIOS = [10.0**n for n in range(16)]
HELD = [ratio for ratio in RATIOS if ratio <= 1e12]  # in which double precision finds an equilibrium


def sliders(k, K: float, c: float = 0.0, C: float = 0.0, pull: float = 0.0) -> mbd.System:
    """Ground -k- 1 kg -K- 2 kg -> pull on a line that is turned."""
    first, second = (mbd.RigidBody(name, m, (0.01,) * 3, axes=AXES) for name, m in (("first", 1.0), ("second", 2.0)))
    place = GROUND.at(axes=AXES)
    joints = [mbd.Prismatic(place, body.at(), axis="x") for body in (first, second)]
    springs = [
        mbd.AxialSpringDamper(place, first.at(), axis="x", stiffness=k, damping=c, name="soft"),
        mbd.AxialSpringDamper(first.at(), second.at(), axis="x", stiffness=K, damping=C),
        mbd.Force(second.at(), (pull * AXES[:, 0]).tolist()),
    ]
    return mbd.System([first, second], joints, springs)


def lowest(k: float, K: float) -> float:
    """Lowest frequency [Hz] of `sliders`, without differences of large numbers."""
    total, product = (k + K) + K / 2.0, k * K / 2.0
    return math.sqrt(2.0 * product / (total + math.sqrt(total**2 - 4.0 * product))) / (2.0 * math.pi)


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_soft_spring_in_series_with_a_stiff_one(ratio: float) -> None:
    """It was lost in the sum of both from a ratio of 1e10 on: the frequency was zero."""
    rest = mbd.equilibrium(sliders(1.0, ratio))
    expected = lowest(1.0, ratio)
    assert float(rest.frequencies[0, 0]) == pytest.approx(expected, rel=1e-9)
    assert float(rest.vibrations[0].frequencies[0]) == pytest.approx(expected, rel=1e-9)
    assert float(rest.poles[0, 1].imag) == pytest.approx(2.0 * math.pi * expected, rel=1e-9)
    assert sliders(1.0, ratio).describe().frequencies[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("ratio", RATIOS)
def test_it_has_its_derivative(ratio: float) -> None:
    k = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
    rest = mbd.equilibrium(sliders(mbd.variable(1.0), ratio), designs={"soft.stiffness": k})
    [slope] = torch.autograd.grad(rest.frequencies[0, 0], k)
    step = 1e-4
    expected = (lowest(1.0 + step, ratio) - lowest(1.0 - step, ratio)) / (2.0 * step)
    assert float(slope) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("ratio", HELD)
def test_it_gives_way_to_a_force(ratio: float) -> None:
    """The end moves by F / k + F / K, with the derivative -F / k^2."""
    k = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
    rest = mbd.equilibrium(sliders(mbd.variable(1.0), ratio, pull=0.5), designs={"soft.stiffness": k})
    moved = rest.body("second").r.reshape(3) @ AXES[:, 0]
    [slope] = torch.autograd.grad(moved, k)
    assert float(moved) == pytest.approx(0.5 * (1.0 + 1.0 / ratio), rel=1e-12)
    assert float(slope) == pytest.approx(-0.5, rel=1e-8)
    assert float(rest.frequencies[0, 0]) == pytest.approx(lowest(1.0, ratio), rel=1e-9)


def test_a_ratio_that_double_precision_does_not_hold_is_refused() -> None:
    with refused("system", None, "no static equilibrium", "stiffnesses of springs in series within a factor of 1e+13"):
        mbd.equilibrium(sliders(1.0, 1e14, pull=0.5))


@pytest.mark.parametrize("ratio", [1e6, 1e10, 1e12])
def test_it_has_its_damping(ratio: float) -> None:
    """A stiff damper beside the stiff spring does nothing to a soft vibration: Re s = -c / 2 (m1 + m2)."""
    rest = mbd.equilibrium(sliders(1.0, ratio, c=0.1, C=1e-6 * ratio))
    slow = rest.poles[0][rest.poles[0].abs() < 10.0]
    assert len(slow) == 2
    assert_close(slow.real, torch.full((2,), -0.1 / 6.0, dtype=torch.float64), rtol=10.0 / ratio + 1e-9, atol=0.0)


def pair(stiff: float | None, mounted: bool) -> mbd.System:
    """Two bodies that a stiff bushing, or a fixed joint, holds together, the first of them on a bushing or free."""
    place, point = torch.tensor([0.3, -0.2, 0.5]).double(), torch.tensor([0.2, 0.1, -0.3]).double()
    other = torch.tensor([0.9, 0.4, 0.6]).double()
    first = mbd.RigidBody("first", 0.7, INERTIA, position=place.tolist(), axes=AXES)
    second = mbd.RigidBody("second", 1.3, INERTIA, position=other.tolist())
    ends = first.at(*point.tolist(), axes=AXES.T), second.at(*(place + AXES @ point - other).tolist())
    joints, forces = [], []
    if stiff is None:
        joints.append(mbd.Fixed(*ends))
    else:
        forces.append(mbd.Bushing(*ends, stiff, turning_stiffness=stiff))
    if mounted:
        forces.append(
            mbd.Bushing(GROUND.at(*place.tolist()), first.at(axes=AXES.T), (1.0, 2.0, 3.0), turning_stiffness=1.0)
        )
    return mbd.System([first, second], joints, forces, free=["first", "second"])


@pytest.mark.parametrize("stiff", [1e6, 1e10, 1e12])
def test_a_stiff_bushing_is_a_fixed_joint(stiff: float) -> None:
    rigid, soft = (mbd.equilibrium(pair(x, mounted=True)).frequencies[0] for x in (None, stiff))
    assert len(rigid) == 6
    rounding = (
        1e-16 * stiff
    )  # of places of about 1 m: so much force [N] stays in the stiff mount beside soft ones of 1 N/m
    assert_close(soft[:6], rigid, rtol=100.0 / stiff + rounding + 1e-9, atol=0.0)


@pytest.mark.parametrize("stiff", [1.0, 1e6, 1e12])
def test_free_motions_beside_stiff_springs_are_free(stiff: float) -> None:
    frequencies = pair(stiff, mounted=False).describe().frequencies
    assert list(frequencies[:6]) == [0.0] * 6
    assert min(frequencies[6:]) > 0.05 * math.sqrt(stiff)
