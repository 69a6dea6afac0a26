"""A spacecraft that turns by its wheel and shakes its two panels. Chosen, no publication."""

from __future__ import annotations

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)


def build(angle: float = 45.0, turn: float = 60.0, move: float = 4.0) -> mbd.System:
    """Plies of the panels at +-angle [deg]; a free body is turned by `turn` [deg] within `move` [s] against the ground."""
    skin = mbd.Laminate(CARBON, mbd.deg([angle, -angle]), thickness=0.6e-3)
    mesh = mbd.mesh.rectangle(2.5, 0.8, cells=(10, 4))
    hub = mbd.RigidBody("hub", 120.0, (30.0, 30.0, 30.0))
    on_edge = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    panels = [
        mbd.FlexibleBody.plate(name, mesh, skin, modes=3, position=(side * 1.65, 0, 0), axes=on_edge, reference=edge)
        for name, side, edge in (("port", -1, "right_edge"), ("starboard", 1, "left_edge"))
    ]
    ground = mbd.Ground()
    return mbd.System(
        [hub, *panels],
        [
            mbd.Revolute(ground.at(), hub.at(), axis="z"),
            mbd.Drive(ground, hub, axis="z", angle=mbd.SmoothStep(size=mbd.deg(turn), duration=move)),
            mbd.Fixed(hub.at(-0.4, 0, 0), panels[0].at("right")),
            mbd.Fixed(hub.at(0.4, 0, 0), panels[1].at("left")),
        ],
    )


def motion() -> mbd.Trajectory:
    """The turn, and what is left of it."""
    return mbd.simulate(build(), 8.0, steps=800, gradients="none")
