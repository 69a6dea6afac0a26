"""States at many speeds are those of a search from speed to speed; drives turn at each of the speeds, whatever their laws."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.extensions.vibrations.steady_states import Shaft, steady_states
from torchmbd.multibody.equilibrium import equilibrium as search

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


def shaft(drive: float | None) -> mbd.System:
    """A disk in the middle of a flexible shaft in round bearings, critical at about 66 rad/s; drive: speed of its law."""
    steel = mbd.GivenSection.isotropic(210e9, 0.3, 7850.0, 3e-4, Iyy=8e-9, Izz=8e-9, J=16e-9)
    beam = mbd.FlexibleBeam("shaft", mbd.BeamLine.straight(1.0, elements=2), steel)
    disk, ground = mbd.RigidBody("disk", 15.0, (0.04, 0.02, 0.02), position=(0.5, 0, 0)), mbd.Ground()
    joints: list[mbd.Joint] = [mbd.Fixed(beam.at(1), disk.at())]
    joints += [] if drive is None else [mbd.Drive(ground, disk, axis="x", speed=drive)]
    bearings = [mbd.Bushing(ground.at(x, 0, 0), beam.at(2 * x), (along, 1e6, 1e6)) for x, along in ((0, 1e6), (1, 0.0))]
    return mbd.System([beam, disk], joints, bearings)


@pytest.mark.thorough
@pytest.mark.parametrize("law", [0.0, 100.0])
def test_a_drive_with_any_law_changes_no_vibration_across_the_shaft(law):
    """Also above the critical speed, where Coriolis's forces hold the shaft, and not its stiffness; at one speed or many."""
    turning = Shaft("x", observer="ground")
    free = steady_states(shaft(None), [30.0, 150.0], turning).eigenvalues("natural")[0]
    for speeds, rows in (([30.0, 150.0], [0, 1]), ([150.0], [1])):
        driven = steady_states(shaft(law), speeds, turning).eigenvalues("natural")[0]
        assert_close(driven[:, :4], free[rows, 1:5], rtol=1e-8, atol=0.0)
