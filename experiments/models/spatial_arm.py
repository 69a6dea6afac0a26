"""A spatial arm of two laminated tubes under gravity: a shoulder turns about the vertical, an elbow lifts, a tool is carried.

    designs    ply angles and wall thickness of both tubes, length of the upper one
    move       0.4 s; then the arm holds its place, and the tool vibrates

Chosen, no publication. The question is asked in configs/spatial_arm/least_vibration.yaml, and in Python by `problem` here.
Checked in tests/experiments/test_spatial_arm.py.
"""

from __future__ import annotations

import torch

import torchmbd as mbd

MOVE, END = 0.4, 0.6  # [s]
PAYLOADS = [0.5 + 0.05 * k for k in range(20)]  # [kg]
SMALL = (1e-4, 1e-4, 1e-4)


def tube(name: str, length: float | torch.nn.Parameter, radius: float, at: float, around: int) -> mbd.FlexibleBody:
    """A tube of four layers along x; `at`: where its middle is."""
    wall = mbd.variable(0.3e-3)  # of each ply [m]
    section = mbd.sections.tube(radius, mbd.examples.carbon(), mbd.deg([45, -45, 45, -45]), wall, cells=(around, 1))
    line = mbd.BeamLine.straight(length, 4)
    # The static modes of its end: 4 vibration modes make the arm 6 % too stiff, and the objective half as large.
    return mbd.FlexibleBody.beam(
        name,
        line,
        section,
        modes=0,
        reduction="craig-bampton",
        interface=["end"],
        position=(at, 0, 0),
        reference="start",
    )


def build(around: int = 16) -> mbd.System:
    """The arm, level at the start; around: cells around the tubes."""
    upper = tube("upper", mbd.variable(0.5), 0.02, 0.25, around)
    fore = tube("fore", 0.4, 0.015, 0.7, around)
    hub = mbd.RigidBody("hub", 1.0, SMALL)
    elbow, lift = mbd.RigidBody("elbow", 0.5, SMALL, (0.5, 0, 0)), mbd.RigidBody("lift", 0.1, SMALL, (0.5, 0, 0))
    tool = mbd.RigidBody("tool", mbd.variable(0.5), SMALL, position=(0.9, 0, 0))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), hub.at(), axis="z", name="shoulder"),
        mbd.Drive(ground, hub, axis="z", angle=mbd.SmoothStep(mbd.deg(60), MOVE), name="turn"),
        mbd.Fixed(hub.at(), upper.at("start"), name="root"),
        mbd.Fixed(upper.at("end"), elbow.at(), name="housing"),
        mbd.Revolute(elbow.at(), lift.at(), axis="y", name="hinge"),
        mbd.Drive(elbow, lift, axis="y", angle=mbd.SmoothStep(mbd.deg(-30), MOVE), name="raise"),
        mbd.Fixed(lift.at(), fore.at("start"), name="clamp"),
        mbd.Fixed(fore.at("end"), tool.at(), name="grip"),
    ]
    return mbd.System([hub, upper, elbow, lift, fore, tool], joints, gravity=(0, 0, -9.81))


def problem(around: int = 16, payloads: list[float] = PAYLOADS, steps: int = 300) -> mbd.Scenarios:
    """Least vibration of the tool after the move, in the mean of the payloads; mass and failure are limited."""
    vx, vy, vz = (mbd.Velocity("tool", axis=axis) for axis in "xyz")
    mass = mbd.Mass("upper") + mbd.Mass("fore")
    return mbd.Scenarios(
        build(around),
        END,
        mbd.Integral(vx**2 + vy**2 + vz**2, window=(MOVE, END)),
        [mass <= "initial", *(mbd.Max(mbd.PlyFailure(name)) <= 0.5 for name in ("upper", "fore"))],
        scenarios=[{"tool.mass": m} for m in payloads],
        objective="mean",
        constraints="worst",
        variables=[f"{name}.section.{what}" for name in ("upper", "fore") for what in ("angles", "thickness")]
        + ["upper.line.length"],
        bounds={
            "upper.section.angles": mbd.deg([-90, 90]),
            "upper.section.thickness": (0.2e-3, 0.6e-3),
            "fore.section.angles": mbd.deg([-90, 90]),
            "fore.section.thickness": (0.2e-3, 0.6e-3),
            "upper.line.length": (0.45, 0.55),
        },
        steps=steps,
        motion_start="equilibrium",
    )
