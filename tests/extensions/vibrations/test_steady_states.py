"""States at many speeds are those that a search from speed to speed finds, whether all are found at once or one by one."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.extensions.vibrations.steady_states import steady_states
from torchmbd.multibody.system import equilibrium as search

SPEEDS = torch.linspace(2.0, 14.0, 13, dtype=torch.float64)


def governor() -> mbd.System:
    """A bob on an arm that hangs beside the axis: it swings outward with the speed."""
    hub, bob = mbd.RigidBody("hub", 1.0, (1e-3,) * 3), mbd.RigidBody("bob", 2.0, (1e-6,) * 3, position=(0.1, 0.0, -0.5))
    joints = [
        mbd.Revolute(mbd.Ground().at(), hub.at(), axis="z"),
        mbd.Drive(mbd.Ground(), hub, axis="z", speed=1.0),
        mbd.Revolute(hub.at(0.1, 0.0, 0.0), bob.at(0.0, 0.0, 0.5), axis="y"),
    ]
    return mbd.System([hub, bob], joints, gravity=(0.0, 0.0, -9.81))


def heights() -> torch.Tensor:
    states = steady_states(governor(), SPEEDS)
    return states.q[2 * 2 + 1, 0]  # z of the second body


@pytest.mark.thorough
def test_a_governor_swings_outward_with_the_speed(monkeypatch):
    """tan a = w^2 (e + L sin a) / g, of which the bob is L cos a below the hub."""
    z, calls = heights(), []
    for w, height in zip(SPEEDS.tolist(), z.tolist(), strict=True):
        a = math.acos(-height / 0.5)
        assert abs(math.sin(a) * 9.81 - w * w * (0.1 + 0.5 * math.sin(a)) * math.cos(a)) < 1e-8 * w * w
    original = search._find_equilibrium
    monkeypatch.setattr(search, "_find_equilibrium", lambda *x: calls.append(x) or original(*x))
    assert_close(heights(), z, rtol=1e-10, atol=0.0)
    at_once = len(calls)
    monkeypatch.setattr(search, "_NEAR", -1.0)  # no step between neighbors is near enough
    assert_close(heights(), z, rtol=1e-10, atol=0.0)
    assert at_once < len(SPEEDS) == len(calls) - at_once
