"""A chain of flexible links that falls under gravity. Chosen, no publication."""

from __future__ import annotations

from itertools import pairwise

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
LINK = 0.3  # length [m]


def build(links: int = 5) -> mbd.System:
    """Links along x, hinged to each other about z and to the ground at the origin."""
    section = mbd.sections.strip(0.02, CARBON, mbd.deg([0.0, 0.0]), thickness=0.8e-3, cells=(6, 1))
    line = mbd.BeamLine.straight(LINK, elements=4)
    flat = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # the strip bends in the plane of motion
    bodies = [
        mbd.FlexibleBody.beam(f"link{k}", line, section, modes=3, position=(LINK * (k + 0.5), 0, 0), axes=flat).damped(
            0.02
        )
        for k in range(links)
    ]
    ground = mbd.Ground()
    joints: list[mbd.Revolute] = [mbd.Revolute(ground.at(), bodies[0].at("start", axes=_turned()), axis="z")]
    for a, b in pairwise(bodies):
        joints.append(mbd.Revolute(a.at("end", axes=_turned()), b.at("start", axes=_turned()), axis="z"))
    return mbd.System(bodies, joints, gravity=(0, -9.81, 0))


def _turned() -> list[list[float]]:
    """Ground axes as the links have them where they start."""
    return [[1, 0, 0], [0, 0, 1], [0, -1, 0]]


def motion() -> mbd.Trajectory:
    """The fall, 1.2 s."""
    return mbd.simulate(build(), 1.2, steps=1200, gradients="none")
