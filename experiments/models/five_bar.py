"""A five-bar pick-and-place robot in the vertical plane x-z: tubes as upper arms, plates as forearms, a tool with payload.

Chosen, no publication. Both motors turn by ANGLE within MOVE and stand still until END. What vibrates in the dwell is so small
beside the move that steps which resolve the move do not resolve it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torchmbd as mbd

HALF, UPPER = 0.08, 0.20  # half the distance of the motors, length of the upper arms [m]
MOVE, END, ANGLE = 0.5, 0.7, 30.0  # end of the move and of the dwell [s], turn of the motors [deg]
TOOL = (0.0, 0.0, -0.40)  # first position [m]
SMALL = (2e-5, 2e-5, 2e-5)  # moments of inertia of hubs and tool [kg m^2]


def build(payload: float = 0.5) -> mbd.System:
    """The robot with a tool of this mass [kg]; variables are the mass, and angles, wall and length of the members."""
    ply, length = mbd.examples.carbon(), mbd.variable(UPPER)
    section = mbd.sections.tube(0.012, ply, mbd.deg([45, -45]), thickness=mbd.variable(0.3e-3), cells=(16, 1))
    laminate = mbd.Laminate(ply, angles=mbd.deg([45, -45, 45]), thickness=0.6e-3)
    ground = mbd.Ground()
    tool = mbd.RigidBody("tool", mbd.variable(payload), SMALL, position=TOOL)
    bodies, joints = [], []
    for side, sign in (("left", -1.0), ("right", 1.0)):
        motor = (sign * HALF, 0.0, 0.0)
        down = (sign * math.cos(math.radians(40)), 0.0, -math.sin(math.radians(40)))
        elbow = tuple(m + UPPER * d for m, d in zip(motor, down, strict=True))
        hub = mbd.RigidBody(f"{side}_hub", 0.3, SMALL, position=motor)
        upper = mbd.FlexibleBody.beam(
            f"{side}_upper",
            mbd.BeamLine.straight(length, 4),
            section,
            modes=0,
            reduction="craig-bampton",
            interface=["end"],
            reference="start",
            position=motor,
            axes=_axes(motor, elbow),
        )
        fore = mbd.FlexibleBody.plate(
            f"{side}_fore",
            mbd.mesh.rectangle(length=math.dist(TOOL, elbow), width=0.04, cells=(6, 2)),
            laminate,
            modes=2,
            reduction="craig-bampton",
            interface=["left", "right"],
            position=tuple(0.5 * (a + b) for a, b in zip(elbow, TOOL, strict=True)),
            axes=_axes(elbow, TOOL),
        )
        bodies += [hub, upper, fore]
        move = mbd.SmoothStep(mbd.deg(ANGLE), MOVE)
        joints += [
            mbd.Revolute(ground.at(*motor), hub.at(), axis="y", name=f"{side}_shoulder"),
            mbd.Drive(ground, hub, axis="y", angle=move, name=f"{side}_motor"),
            mbd.Fixed(hub.at(), upper.at("start"), name=f"{side}_root"),
        ]
        if side == "left":
            joints += [
                mbd.Revolute(upper.at("end"), fore.at("left"), axis="y", name="left_elbow"),
                mbd.Fixed(fore.at("right"), tool.at(), name="left_wrist"),
            ]
        else:
            joints += [
                mbd.Spherical(upper.at("end"), fore.at("left"), name="right_elbow"),
                mbd.Universal(fore.at("right"), tool.at(), axes="yz", name="right_wrist"),
            ]
    return mbd.System([*bodies, tool], joints, gravity=(0, 0, -9.81))


def problem(steps: int | None) -> mbd.Problem:
    """Least vibration in the dwell, limits on failure of the left members; steps of the motion, None: by its errors."""
    squares = [mbd.Velocity("tool", axis) ** 2 for axis in "xyz"]
    vibration = mbd.Integral(squares[0] + squares[1] + squares[2], window=(MOVE, END))
    plies = {"left_upper": "left_upper.section.angles", "left_fore": "left_fore.laminate.angles"}
    return mbd.Problem(
        build(),
        duration=END,
        steps=steps,
        start="equilibrium",
        minimize=vibration,
        subject_to=[mbd.Max(mbd.PlyFailure(body)) <= 0.5 for body in plies],
        bounds={angles: mbd.deg([-90, 90]) for angles in plies.values()},
    )


def _axes(a: tuple[float, ...], b: tuple[float, ...]) -> Tensor:
    """Axes of a member as columns: x from a to b, y out of the plane."""
    along = torch.tensor(b, dtype=torch.float64) - torch.tensor(a, dtype=torch.float64)
    out = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    along = along / along.norm()
    return torch.stack([along, out, torch.linalg.cross(along, out)], dim=1)
