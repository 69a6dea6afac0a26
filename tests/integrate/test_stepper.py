"""Corrections of tangents: what decides on their number."""

from __future__ import annotations

import pytest

import torchmbd as mbd

NAME = "push.z"


def arm() -> mbd.System:
    """A driven arm with a bob, pushed along the axis of its drive: the joint carries all that the push does."""
    ground, inertia = mbd.Ground(), (1e-3, 1e-3, 1e-3)
    arm, bob = mbd.RigidBody("arm", 1.0, inertia), mbd.RigidBody("bob", 0.5, inertia, position=(0.4, 0, 0))
    return mbd.System(
        bodies=[arm, bob],
        joints=[
            mbd.Revolute(ground.at(), arm.at(), axis="z"),
            mbd.Drive(ground, arm, axis="z", speed=3.0),
            mbd.Revolute(arm.at(0.3, 0, 0), bob.at(-0.1, 0, 0), axis="z"),
        ],
        forces=[mbd.Force(arm.at(0.2, 0, 0), (0.0, 0.0, mbd.variable(2.0)), name="push")],
        gravity=(0.0, -9.81, 0.0),
    )


@pytest.mark.thorough
def test_tangents_that_are_nothing_but_rounding_call_for_no_corrections() -> None:
    motion = mbd.simulate(arm(), 0.2, steps=100, gradients="forward", variables=[NAME]).require_ok()
    assert motion.dv_db is not None
    assert float(motion.dv_db.abs().max()) < 1e-12
    assert float(motion.stats["tangent_error"].max()) < 1e-5
