"""A robot arm: a laminated tube that a motor turns by a quarter from rest to rest, with a tool hanging below its end."""

from __future__ import annotations

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)


def build(
    layers: int = 2,
    length: float = 1.0,
    radius: float = 0.02,
    wall: float = 1.6e-3,
    drop: float = 0.2,
    move: float = 0.4,
    elements: int = 8,
) -> mbd.System:
    """The arm lies along x and turns about z.

    layers         plies of the wall, inside to outside; their angles are the design
    length, radius of the tube, wall: its thickness [m]
    drop           how far below the tube's end the tool hangs [m]: turning the arm twists the tube
    move           how long the motor turns [s]
    elements       of the arm's beam
    """
    ground = mbd.Ground()
    angles = mbd.deg([45.0 if k % 2 == 0 else -45.0 for k in range(layers)])
    section = mbd.sections.tube(radius, CARBON, angles, thickness=wall / layers, cells=(24, 1))
    line = mbd.BeamLine.straight(length, elements)
    # The tool is heavier than the arm: the six static shapes of the arm's end carry the motion, no vibration mode is added.
    arm = mbd.FlexibleBody.beam(
        "arm", line, section, reference="start", reduction="craig-bampton", interface="end", modes=0, damping=1e-4
    )
    hub = mbd.RigidBody("hub", mass=1.0, inertia=(1e-3, 1e-3, 1e-3))
    tool = mbd.RigidBody("tool", mass=1.5, inertia=(2e-3, 2e-3, 2e-3), position=(length, 0, -drop))
    return mbd.System(
        bodies=[hub, arm, tool],
        joints=[
            mbd.Revolute(ground.at(0, 0, 0), hub.at(0, 0, 0), axis="z"),
            mbd.Drive(ground, hub, axis="z", angle=mbd.SmoothStep(size=mbd.deg(90.0), duration=move)),
            mbd.Fixed(hub.at(0, 0, 0), arm.at("start")),
            mbd.Fixed(arm.at("end"), tool.at(0, 0, drop)),
        ],
    )
