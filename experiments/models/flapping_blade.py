"""A blade that flaps about a hinge, its walls wound at an angle that couples bending with twist. Chosen, no publication."""

from __future__ import annotations

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)


def build(angle: float = 25.0, frequency: float = 0.8) -> mbd.System:
    """Walls at angle [deg]; the root flaps by 20 degrees with the frequency [Hz]."""
    section = mbd.sections.strip(0.08, CARBON, mbd.deg([angle, angle]), thickness=1.5e-3, cells=(8, 1))
    line = mbd.BeamLine.straight(1.0, elements=10)
    blade = mbd.FlexibleBody.beam("blade", line, section, modes=4, reference="start").damped(0.01)
    root = mbd.RigidBody("root", 0.5, (1e-3, 1e-3, 1e-3))
    ground = mbd.Ground()
    flap = mbd.Sine(amplitude=mbd.deg(20.0), frequency=frequency)
    return mbd.System(
        [root, blade],
        [
            mbd.Revolute(ground.at(), root.at(), axis="y"),
            mbd.Drive(ground, root, axis="y", angle=flap),
            mbd.Fixed(root.at(), blade.at("start")),
        ],
    )


def motion() -> mbd.Trajectory:
    """Two periods."""
    return mbd.simulate(build(), 2.0 / 0.8, steps=800, gradients="none")
