"""Energy that comes from nothing after a switch is told, of modes and of exact beams, and only where there is some."""

from __future__ import annotations

import pytest

import torchmbd as mbd

LENGTH, WIDTH, HEIGHT = 0.8, 0.02, 0.004
MATERIAL = mbd.Ply.isotropic(E=70e9, nu=0.3, density=2700.0)
LOCKED = [mbd.Phase(until=0.1), mbd.Phase(lock=["hinge"])]


def arm(exact: bool) -> mbd.System:
    """A slender arm that falls on a hinge with a mass at its end."""
    section = mbd.sections.rectangle(WIDTH, HEIGHT, MATERIAL, cells=(4, 2))
    tip = mbd.RigidBody("tip", 0.1, (1e-5, 1e-5, 1e-5), position=(LENGTH, 0, 0))
    line = mbd.BeamLine.straight(LENGTH, elements=3)
    if exact:
        rod = mbd.FlexibleBeam("rod", line, section, orientation=(0, 0, 1.0), damping=1e-3)
    else:
        rod = mbd.FlexibleBody.beam("rod", line, section, orientation=(0, 0, 1.0), damping=1e-3, modes=8)
    joints = [
        mbd.Revolute(mbd.Ground().at(), rod.at("start"), axis="z", name="hinge"),
        mbd.Fixed(rod.at("end"), tip.at(), name="weld"),
    ]
    return mbd.System([rod, tip], joints, gravity=(0, -9.81, 0))


@pytest.mark.thorough
@pytest.mark.parametrize("exact", [True, False])
def test_a_lane_is_unresolved_where_it_gains_energy(exact):
    """A lock stops the axial motion of an exact beam in less than a step, of 1 ms; modes have none of it.

    Another status may come first: accelerations that alternate.
    """
    motion = mbd.simulate(arm(exact), 0.11, steps=110, phases=LOCKED, gradients="none", diagnose=False)
    energies = motion.energies
    share = float(energies.balance.abs().max() / (energies.kinetic + energies.strain).max())
    assert (share > 0.5) is exact
    assert motion.status[0].startswith("unresolved: ") is exact
