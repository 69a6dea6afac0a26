"""Energies of a motion in phases that change nothing are those of the motion in one piece."""

from __future__ import annotations

import pytest
from torch.testing import assert_close

import torchmbd as mbd


@pytest.mark.parametrize("ends", [[0.3], [0.1, 0.2, 0.45]])
def test_phases_that_change_nothing_leave_the_energies(ends):
    bob, ground = mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01), position=(1, 0, 0)), mbd.Ground()
    hinge = mbd.Revolute(ground.at(), bob.at(-1.0, 0, 0), axis="z")
    spring = mbd.SpringDamper(ground.at(0, 1, 0), bob.at(), stiffness=20.0, damping=2.0, rest=0.5)
    system = mbd.System([bob], [hinge], [spring], gravity=(0, -9.81, 0))
    phases = [*(mbd.Phase(until=t) for t in ends), mbd.Phase()]
    whole, parts = (mbd.simulate(system, 0.6, steps=120, phases=x).energies for x in (None, phases))
    for name in ("kinetic", "applied", "stored"):
        assert_close(getattr(parts, name), getattr(whole, name), rtol=1e-4, atol=1e-4)
    assert float(whole.applied[0, -1].abs()) > 1.0
