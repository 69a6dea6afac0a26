"""An arm of two bars falls: its elbow meets a stop, its tip the floor, where it slides with friction.

Chosen, no publication.
"""

from __future__ import annotations

import torchmbd as mbd

LENGTH, HEIGHT, FLOOR = 0.5, 0.0, -0.75  # of a bar, of the shoulder, of the floor [m]


def build() -> mbd.System:
    """Straight to the right at the start; the elbow bends upwards to 10 degrees and downwards to 100."""
    bars = [
        mbd.RigidBody(name, 0.5, (0.0, 0.0104, 0.0104), center=(0.5 * LENGTH, 0, 0), position=(k * LENGTH, HEIGHT, 0))
        for k, name in enumerate(("upper", "fore"))
    ]
    upper, fore = bars
    ground, elbow = mbd.Ground(), upper.at(LENGTH, 0, 0)
    joints = [
        mbd.Revolute(ground.at(0, HEIGHT, 0), upper.at(), axis="z", name="shoulder"),
        mbd.Revolute(elbow, fore.at(), axis="z", name="elbow"),
    ]
    limits = {"lower": float(mbd.deg(-100.0)), "upper": float(mbd.deg(10.0))}
    forces = [
        mbd.RotationalStop(elbow, fore.at(), "z", **limits, stiffness=500.0, damping=0.1, name="stop"),
        mbd.PlaneContact(
            ground.at(0, FLOOR, 0),
            fore.at(LENGTH, 0, 0),
            normal="y",
            stiffness=2e4,
            damping=0.2,
            friction=0.3,
            speed=0.05,
            name="floor",
        ),
        mbd.RotationalSpringDamper(ground.at(0, HEIGHT, 0), upper.at(), "z", damping=0.05, name="loss"),
    ]
    return mbd.System(bars, joints, forces, gravity=(0, -9.81, 0))


def motion() -> mbd.Trajectory:
    """Two seconds."""
    return mbd.simulate(build(), 2.0, steps=4000, gradients="none")
