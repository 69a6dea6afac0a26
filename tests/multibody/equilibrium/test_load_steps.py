"""Equilibria of systems with beams by load steps: rolled up, bent in space, buckled, snapped through."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.exact_beam.cases import bend, given, matrix
from tests.refused import ANY, refused

GROUND = mbd.Ground()


def cantilever(beam: mbd.FlexibleBeam, *forces: mbd.forces.ForceElement) -> mbd.System:
    return mbd.System([beam], [mbd.Fixed(GROUND.at(), beam.at("start"), name="wall")], list(forces))


@pytest.mark.thorough
@pytest.mark.parametrize("turns", [1.0, 1.5])
def test_roll_up(turns):
    """M = 2 pi E I / L: a circle, closed after one turn, half of one further on after one and a half."""
    beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(10.0, 5), given(1e4, 5e3, 5e3, 100.0, 100.0, 100.0))
    moment = turns * 2.0 * math.pi * 100.0 / 10.0
    rest = mbd.equilibrium(cantilever(beam, mbd.Torque(beam.at("end"), (0.0, 0.0, moment))))
    angle, radius = 2.0 * math.pi * turns, 10.0 / (2.0 * math.pi * turns)
    expected = torch.tensor([radius * math.sin(angle), radius * (1.0 - math.cos(angle)), 0.0], dtype=torch.float64)
    assert_close(rest.body("beam").nodes[0, 0, -1], expected, atol=1e-9, rtol=0)


@pytest.mark.thorough
def test_bend_at_five_times_the_load():
    alone = bend(4)
    beam = mbd.FlexibleBeam("bend", alone.mesh, alone.section)
    push = torch.tensor([600.0, 3000.0], dtype=torch.float64)
    force = mbd.Force(beam.at("end"), lambda t: torch.stack([0.0 * t, 0.0 * t, 600.0 + 2400.0 * t]))
    rest = mbd.equilibrium(cantilever(beam, force), times=[0.0, 1.0])
    for k, load in enumerate(push.tolist()):
        expected = alone.equilibrium({"end": (0.0, 0.0, load)}).nodes
        assert_close(rest.body("bend").nodes[0, k], expected, atol=1e-8, rtol=0)


@pytest.mark.thorough
def test_princeton_beam():
    """13.345 N at 30 degrees from the stiff direction; ANSYS, as in tests/validation/test_exact_beam.py."""
    h, w, E, nu, load, angle = 12.3777e-3, 3.2024e-3, 71.7e9, 0.31, 13.345, math.radians(30.0)
    G, A, Iyy, Izz = E / 2.0 / (1.0 + nu), h * w, h * w**3 / 12.0, w * h**3 / 12.0
    section = given(E * A, G * A, G * A, 0.198 * G * (Iyy + Izz), E * Iyy, E * Izz)
    beam = mbd.FlexibleBeam("strip", mbd.BeamLine.straight(0.508, 20), section)
    force = mbd.Force(beam.at("end"), (0.0, -load * math.cos(angle), load * math.sin(angle)))
    tip = mbd.equilibrium(cantilever(beam, force)).body("strip").nodes[0, 0, -1]
    assert math.dist((-float(tip[1]), float(tip[2])), (0.0166587, 0.117736)) < 0.01 * math.hypot(0.0166587, 0.117736)


ROD = given(2.1e7, 8e6, 8e6, 160.0, 210.0, 210.0)


def column(push: float, aside: float) -> mbd.System:
    """Euler's load is 518 N."""
    beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(1.0, 8), ROD)
    return cantilever(beam, mbd.Force(beam.at("end"), (-push, 0.0, aside)))


@pytest.mark.thorough
def test_column():
    with refused("system", ANY, "buckles at 0.5198"):
        mbd.equilibrium(column(1000.0, 0.0))
    rest = mbd.equilibrium(column(1000.0, 0.1))
    assert rest.stable
    assert float(rest.body("beam").nodes[0, 0, -1, 2]) > 0.5
    half = mbd.equilibrium(column(510.0, 0.0))
    assert half.stable
    assert float(half.vibrations[0].frequencies[0]) < 0.2 * float(
        mbd.equilibrium(column(0.0, 0.0)).vibrations[0].frequencies[0]
    )


@pytest.mark.thorough
def test_snap_through():
    """Half of a flat arch whose middle is guided: the beam alone ends at the same part of the load."""
    line = mbd.BeamLine(torch.tensor([[0.2 * i, 0.04 * i, 0.0] for i in range(6)], dtype=torch.float64))
    section = given(1e6, 5e5, 5e5, 1e4, 1e4, 100.0)  # out of the plane it is stiff
    beam = mbd.FlexibleBeam("beam", line, section)
    guide = mbd.Prismatic(GROUND.at(1.0, 0.2, 0.0), beam.at("end"), axis="y", name="guide")
    supports = {"start": (0.0,) * 6, "end": (0.0, None, 0.0, 0.0, 0.0, 0.0)}
    alone = mbd.ExactBeam("beam", line, section).equilibrium({"end": (0.0, -1e4, 0.0)}, supports=supports)
    factor = alone.status.split(" at ")[1].split()[0]
    wall, push = mbd.Fixed(GROUND.at(), beam.at("start"), name="wall"), mbd.Force(beam.at("end"), (0.0, -1e4, 0.0))
    with refused("system", ANY, f"buckles at {factor}"):
        mbd.equilibrium(mbd.System([beam], [wall, guide], [push]))


@pytest.mark.thorough
@pytest.mark.parametrize("EI", [1e-1, 1e-3, 1e-4])
def test_soft_beam_hangs_as_the_beam_alone(EI):
    """Weight of up to 10,000 E I / L^2; E A = 1e6 N."""
    section = given(1e6, 5e5, 5e5, EI, EI, EI, mass=matrix(0.1, 0.1, 0.1, 2e-6, 1e-6, 1e-6))
    beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(1.0, 6), section)
    wall, gravity = mbd.Fixed(GROUND.at(), beam.at("start"), name="wall"), (0.0, 0.0, -9.81)
    rest = mbd.equilibrium(mbd.System([beam], [wall], gravity=gravity))
    tip, alone = rest.body("beam").nodes[0, 0, -1], beam.equilibrium(gravity=gravity).nodes[-1]
    assert float(tip[2]) < -0.6
    assert_close(tip, alone, atol=5e-3, rtol=0.0)  # masses are at nodes otherwise


@pytest.mark.thorough
def test_drive_that_turns_far():
    """Joints are followed, too: a rod that its hinge turns by 1.2 rad hangs as one that starts there."""

    def hung(angle: float, turned: float) -> torch.Tensor:
        axes = [[math.cos(turned), -math.sin(turned), 0.0], [math.sin(turned), math.cos(turned), 0.0], [0.0, 0.0, 1.0]]
        beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(1.0, 4), given(1e4, 5e3, 5e3, 1.0, 1.0, 1.0), axes=axes)
        hinge = mbd.Revolute(GROUND.at(), beam.at("start"), axis="z", name="hinge")
        drive = mbd.Drive(GROUND.at(axes=axes), beam.at("start"), axis="z", angle=lambda t: angle * t, name="drive")
        rest = mbd.equilibrium(mbd.System([beam], [hinge, drive], gravity=(0.0, -0.5, 0.0)), times=[0.0, 1.0])
        return rest.body("beam").nodes[0, 1, -1]

    assert_close(hung(1.2, 0.0), hung(0.0, 1.2), atol=1e-8, rtol=0)


@pytest.mark.thorough
def test_drive_that_turns_too_far_at_once():
    """Its row is zero half a turn away, too."""
    beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(1.0, 2), given(1e4, 5e3, 5e3, 1.0, 1.0, 1.0))
    hinge = mbd.Revolute(GROUND.at(), beam.at("start"), axis="z", name="hinge")
    drive = mbd.Drive(GROUND.at(), beam.at("start"), axis="z", angle=lambda t: 2.0 * t, name="drive")
    system = mbd.System([beam], [hinge, drive])
    with refused("system", ANY, "half a turn"):
        mbd.equilibrium(system, times=[0.0, 1.0])
    tip = mbd.equilibrium(system, times=[0.0, 0.5, 1.0]).body("beam").nodes[0, 2, -1]
    expected = torch.tensor([math.cos(2.0), math.sin(2.0), 0.0], dtype=torch.float64)
    assert_close(tip, expected, atol=1e-9, rtol=0)
