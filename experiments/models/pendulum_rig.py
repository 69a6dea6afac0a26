"""A pendulum on a rubbing hinge, with an angle sensor that is late: a rig whose friction is not known.

    J theta'' + c theta' + f tanh(theta' / v0) + m g l sin(theta) = 0        theta(t) as the sensor shows it: theta(t - delay)

`measured` is the twin of the rig: the same model with other numbers, and noise. No measurement of a real rig; the files in
configs/pendulum_rig are its output.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

import torchmbd as mbd

TRUTH = {"rub.force": 0.030, "drag.damping": 0.0042, "hinge_b.y": 0.262}  # N m, N m s/rad, m
DELAY, NOISE = 0.018, math.radians(0.25)  # s, rad
RELEASES = {"release_40": 40.0, "release_15": 15.0, "release_25": 25.0}  # degrees


def rig(release: float = 40.0) -> mbd.System:
    """The rig, released from an angle [degrees]; numbers of friction and the arm are those of its drawings."""
    ground, arm, turn = mbd.Ground(), mbd.variable(0.25), math.radians(release)
    axes = [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    place = (0.25 * math.sin(turn), -0.25 * math.cos(turn), 0.0)
    bob = mbd.RigidBody(
        "bob", mass=1.2, inertia=(4e-3, 4e-3, 4e-3), position=place, axes=axes, angular_velocity=(0.0, 0.0, 0.0)
    )
    hinge = mbd.Revolute(ground.at(), bob.at(0.0, arm, 0.0), axis="z", name="hinge")
    friction = mbd.forces.Friction(mbd.variable(0.01), 0.05)
    rub = mbd.RotationalSpringDamper(ground.at(), bob.at(), axis="z", law=friction, name="rub")
    drag = mbd.RotationalSpringDamper(ground.at(), bob.at(), axis="z", damping=mbd.variable(0.001), name="drag")
    return mbd.System([bob], [hinge], [rub, drag], gravity=(0.0, -9.81, 0.0))


def measured(release: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and angles [degrees] that the sensor of the twin shows, every 20 ms from 0.1 s on."""
    system = rig(release)
    designs = {name: mbd.variable(x).detach()[None] for name, x in TRUTH.items()}
    motion = mbd.simulate(system, 4.0, steps=2000, designs=designs, gradients="none").require_ok()
    angle = mbd.Angle("bob", "z")(motion)[0].numpy()
    t = np.round(np.arange(0.1, 4.0, 0.02), 9)
    noise = NOISE * np.random.default_rng(seed).standard_normal(len(t))
    return t, np.degrees(np.interp(t - DELAY, motion.t.numpy(), angle) + noise)


def write_data(folder: Path) -> None:
    """Write the files of configs/pendulum_rig."""
    for seed, (name, release) in enumerate(RELEASES.items()):
        t, angle = measured(release, seed)
        rows = [f"{1e3 * x:.0f},{y:.3f}" for x, y in zip(t, angle, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["t [ms],angle [deg]", *rows, ""]), encoding="utf-8")
