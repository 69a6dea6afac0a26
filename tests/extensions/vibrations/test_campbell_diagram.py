"""Vibrations over speeds: closed forms, followed through crossings and through zero, gradients, lost ones, lanes."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused

GROUND = mbd.Ground()


def masses(damping: float = 0.0) -> mbd.System:
    """Two masses, each on springs that are alike in all directions: 10 and 14 rad/s."""
    bodies, springs = [], []
    for name, w in (("a", 10.0), ("b", 14.0)):
        bodies.append(mbd.RigidBody(name, 2.0, (1.0, 1.0, 1.0)))
        k = 2.0 * w**2
        springs.append(
            mbd.Bushing(
                GROUND.at(), bodies[-1].at(), k, damping, turning_stiffness=(1e4, 1e4, 0.0), name=f"hold_{name}"
            )
        )
    return mbd.System(bodies, forces=springs)


def test_whirl_crosses_and_passes_zero_in_the_turning_frame():
    """w - speed, w, w + speed; the lowest is zero at 10 rad/s, 10 + speed = 14 - speed at 2 rad/s."""
    speeds = torch.linspace(0.5, 12.5, 13, dtype=torch.float64)
    result = mbd.vibrations.campbell(masses(), speeds, modes=6)
    assert result.status == ["ok"]
    expected = torch.stack([(w + n * speeds).abs() for w in (10.0, 14.0) for n in (-1, 0, 1)], 1) / (2.0 * math.pi)
    order = expected[0].argsort()
    assert_close(result.frequencies[0], expected[:, order], rtol=1e-7, atol=1e-7)
    assert_close(result.speeds, speeds)


def test_damping_is_that_of_the_same_pole():
    result = mbd.vibrations.campbell(masses(damping=0.4), [1.0, 2.0], observer="ground", modes=1)
    assert_close(result.damping_ratios[0, :, 0], torch.full((2,), 0.01, dtype=torch.float64), rtol=1e-8, atol=0.0)
    assert_close(result.poles[0, :, 0].real, torch.full((2,), -0.1, dtype=torch.float64), rtol=1e-8, atol=0.0)


def bar() -> mbd.System:
    """A bar that flaps on a hub against a spring: w^2 = speed^2 (1 + m e s / I) + k / I."""
    hub = mbd.RigidBody("hub", 1.0, (1e-3, 1e-3, 1e-3))
    blade = mbd.RigidBody("bar", 2.0, (1e-9, 0.1, 0.1), position=(0.7, 0.0, 0.0))
    joints = [
        mbd.Revolute(GROUND.at(), hub.at(), axis="z"),
        mbd.Drive(GROUND, hub, axis="z", speed=1.0),
        mbd.Revolute(hub.at(0.2, 0, 0), blade.at(-0.5, 0, 0), axis="y", name="root"),
    ]
    spring = mbd.RotationalSpringDamper(hub.at(), blade.at(), axis="y", stiffness=mbd.variable(60.0), name="spring")
    return mbd.System([hub, blade], joints, [spring])


def test_designs_are_lanes_and_gradients_are_those_of_the_closed_form():
    """Drives turn at each of the speeds, not at that of their law."""
    system, speeds = bar(), torch.tensor([0.0, 3.0, 6.0], dtype=torch.float64)
    k = torch.tensor([60.0, 90.0], dtype=torch.float64, requires_grad=True)

    def frequencies(k):
        return mbd.vibrations.campbell(system, speeds, designs={"spring.stiffness": k}).frequencies[..., 0]

    inertia = 0.1 + 2.0 * 0.5**2
    w = (speeds**2 * (1.0 + 2.0 * 0.2 * 0.5 / inertia) + k[:, None] / inertia).sqrt()
    result = frequencies(k)
    assert_close(result, w / (2.0 * math.pi), rtol=1e-8, atol=0.0)
    [reverse] = torch.autograd.grad(result.sum(), k)
    [expected] = torch.autograd.grad(w.sum() / (2.0 * math.pi), k)
    assert_close(reverse, expected, rtol=1e-7, atol=0.0)
    forward = torch.func.jvp(frequencies, (k.detach(),), (torch.ones(2, dtype=torch.float64),))[1]
    assert_close(forward.sum(1), reverse, rtol=1e-9, atol=0.0)


def test_a_vibration_that_is_lost_is_told(monkeypatch):
    monkeypatch.setattr("torchmbd.extensions.vibrations.campbell_diagram.LOST", 1.1)
    result = mbd.vibrations.campbell(masses(), [1.0, 2.5, 3.0], observer="ground", modes=1)
    assert result.status[0].startswith("lost: vibration 1 from 2.5 rad/s on: no shape is like it. Try: smaller steps")
    assert result.frequencies[0, :, 0].isnan().tolist() == [False, True, True]


def test_a_system_without_vibrations_has_none():
    free = mbd.RigidBody("free", 2.0, (1.0, 1.0, 1.0))
    result = mbd.vibrations.campbell(mbd.System([free], [mbd.Prismatic(GROUND.at(), free.at(), axis="x")]), [0.0])
    assert result.frequencies.shape == (1, 1, 0)


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"system": 3}, "system"),
        ({"center": 5}, "center"),
        ({"center": "a"}, "center"),
        ({"modes": 0}, "modes"),
        ({"speeds": [2.0, 1.0]}, "speeds"),
        ({"axis": "w"}, "axis"),
        ({"observer": "nobody"}, "observer"),
    ],
)
def test_wrong_arguments_are_named(change, path):
    with refused(path):
        mbd.vibrations.campbell(**{"system": masses(), "speeds": [0.0, 1.0]} | change)


def tilting_disk(stiffness: tuple[float, float]) -> mbd.System:
    """A disk of 2 kg, about its axis x 0.015, across 0.01 kg m2, in springs for its motion across and for its tilt."""
    body = mbd.RigidBody("disk", 2.0, (0.015, 0.01, 0.01))
    tilt = (0.0, 30.0, 30.0)
    return mbd.System([body], forces=[mbd.Bushing(GROUND.at(), body.at(), (5e5, *stiffness), turning_stiffness=tilt)])


@pytest.mark.thorough
@pytest.mark.parametrize("observer", ["ground", "turning"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_forward_and_backward_whirl_are_told_apart(observer, sign):
    """Tilt: w^2 J - w Jp speed = k; forward whirl is the faster one, whoever sees it and whichever way it rotates."""
    speeds = torch.linspace(1.0, 25.0, 7, dtype=torch.float64)
    axis = (sign, 0.0, 0.0)
    result = mbd.vibrations.campbell(tilting_disk((8e3, 8e3)), speeds, axis=axis, observer=observer, modes=6)
    assert result.status == ["ok"]
    for k, speed in enumerate(speeds.tolist()):
        half, shift = 0.75 * speed, math.sqrt(4e3)
        root = math.sqrt(half**2 + 3e3)
        lines = [(1, root + half), (1, shift), (-1, root - half), (-1, shift), (0, 500.0)]
        if observer == "turning":
            lines = [(sense, abs(w - sense * speed)) for sense, w in lines]
        w = 2.0 * math.pi * result.frequencies[0, k]
        seen = sorted(zip(result.whirl[0, k].tolist(), w.tolist(), strict=True))
        for line, expected in zip(seen, sorted(lines), strict=True):
            assert line == pytest.approx(expected, rel=1e-7)


@pytest.mark.thorough
def test_unequal_bearings_and_rest_have_no_single_sense():
    result = mbd.vibrations.campbell(tilting_disk((8e3, 3e3)), [0.0, 5.0], axis="x", observer="ground", modes=6)
    assert result.whirl[0, 0].tolist() == [0] * 5
    assert sorted(result.whirl[0, 1].tolist()) == [-1, 0, 0, 0, 1]  # tilts alone whirl
