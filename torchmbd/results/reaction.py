"""Reactions of joints along a trajectory: the force and torque that body a exerts on body b through a joint.

    f = -sum of the gradients of lam . Phi by the points of b,   m = -sum over its points (g - o) x df, its axes g x df

o is the point of the frame a, and both vectors are given in the axes of that frame, as a sensor there would read them.
The reaction on body a is the opposite, about the same point. Where rows are redundant their share is that of least norm.
While a phase locks a joint, its reaction contains what the lock transmits.
Checked in tests/results/test_reaction.py: free bodies in equilibrium.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.errors import InputError, one_of, warn
from torchmbd.math.pair import value
from torchmbd.math.rotation import exponential, rotation_matrix
from torchmbd.multibody.bodies import Frame, Ground
from torchmbd.multibody.bodies.rigid import same_body
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import ATTACHED, Data
from torchmbd.multibody.equations.times_as_lanes import as_lanes
from torchmbd.multibody.joints.joint import Joint
from torchmbd.multibody.joints.lock import Lock
from torchmbd.multibody.system import System
from torchmbd.results.body_motion import BodyMotion, point_of, triad_of
from torchmbd.results.motion_data import MotionData
from torchmbd.results.ringing import warn_of_ringing
from torchmbd.summary import Summary, few


@dataclass(frozen=True, repr=False)
class JointReaction(Summary):
    """force [lanes, times, 3] [N] and torque [lanes, times, 3] [N m] on body b at frame a, in its axes; of all rows."""

    force: Tensor
    torque: Tensor

    def _summary(self) -> list[tuple[str, str]]:
        sizes = {"force": (self.force, "N"), "torque": (self.torque, "N m")}
        return [
            (name, f"[lanes, times, 3] = {list(x.shape)}, at most {float(x.detach().norm(dim=-1).max()):.6g} {unit}")
            for name, (x, unit) in sizes.items()
        ]


def reaction(motion: MotionData, name: str) -> JointReaction:
    """The reaction of the joint of that name."""
    joint = joint_named(motion.system, name)
    at = frame_point(motion, joint.a)
    axes = frame_axes(motion, joint.a)
    parts = reaction_on(motion, joint, joint.b, at)
    for kind, x in zip(("force", "torque"), parts, strict=True):
        warn_of_ringing(motion, name, kind, x)
    return JointReaction(*(torch.einsum("ltij,lti->ltj", axes, x) for x in parts))


def joint_named(system: System, name: str) -> Joint:
    """The one joint of that name; InputError if there is none, or several."""
    one_of("joint", name, [joint.name for joint in system.joints])
    joints = [joint for joint in system.joints if joint.name == name]
    if len(joints) > 1:
        raise InputError(
            "name", name, allowed="unique", state=f"is used {len(joints)} times", noun=f"joint name {name!r}"
        )
    return joints[0]


def reaction_on(motion: MotionData, joint: Joint, side: Frame, about: Tensor) -> tuple[Tensor, Tensor]:
    """Force, and torque about the points `about` [lanes, times, 3], on the body of one side, in ground axes."""
    T = motion.dynamics.topology
    acting = {joint.name, *(x.name for x in motion.system.joints if isinstance(x, Lock) and x.of == joint.name)}
    for rank in motion.ranks:
        if acting.intersection(rank.undetermined):
            warn(
                f"over-constraint: equilibrium does not determine all loads of joint {joint.name!r}, because "
                f"{few(rank.redundant)} follow from other rows. The program returns the reactions with the smallest norm. "
                "Try: joints with fewer constraints, such as mbd.Spherical"
            )
            break
    rows = torch.tensor([name in acting for name in T.row_joints])
    _, at = placement_at_times(motion)
    # Of lam . Phi of these rows, by attached vectors [3, vectors, 1, lanes x times].
    gradient = equations.force_on_vectors(T, at, in_lanes(motion.lam * rows))
    force = torque = torch.zeros_like(motion.v[..., :3])
    for i, attached in enumerate(T.attached):
        if same_body(attached.body, side.body):
            f, g = at_times(motion, gradient[:, i]), at_times(motion, at.g[:, i])
            arm = g - about if attached.is_point else g
            force = force - f if attached.is_point else force
            torque = torque - torch.linalg.cross(arm.expand_as(f), f, dim=-1)
    return force, torque


def frame_point(motion: MotionData, frame: Frame) -> Tensor:
    """Point of a frame in ground axes [lanes, times, 3] [m]."""
    if isinstance(frame.body, Ground):
        return point_of(motion, frame).expand(motion.lanes, len(motion.t), 3)
    return BodyMotion(motion, frame.body.name).at(frame).position


def frame_axes(motion: MotionData, frame: Frame) -> Tensor:
    """Axes of a frame, columns in ground axes [lanes, times, 3, 3]; those on nodes turn with them."""
    if isinstance(frame.body, Ground):
        return triad_of(motion, frame).expand(motion.lanes, len(motion.t), 3, 3)
    view = BodyMotion(motion, frame.body.name)
    if frame.interpolation is None:
        return view.A @ triad_of(motion, frame)
    turn = frame.interpolation.motion(frame.body.mesh.nodes - frame.body.origin, view.psi)[:, 3:]
    elastic = rotation_matrix(exponential(torch.einsum("lim,ltm->ilt", turn, view.w)))
    return view.A @ elastic.movedim((0, 1), (-2, -1)) @ triad_of(motion, frame)


def placement_at_times(motion: MotionData) -> tuple[Data, equations.Placement]:
    """Data of attached vectors and laws of forces, and the placement of bodies, with lanes x times as lanes."""
    T, data = motion.dynamics.topology, motion.dynamics.data
    lanes, times = motion.lanes, len(motion.t)
    vectors = {key: value(x) for key, x in data.items() if key in ATTACHED or key.startswith("law ")}
    wide = {key: x.repeat_interleave(times, -1) if x.shape[-1] > 1 else x for key, x in vectors.items()}
    schedule = T.schedule(motion.t, {name: value(x) for name, x in data.items()})
    prescribed = as_lanes(schedule, lanes, lanes_first=True)._replace(t=motion.t.repeat(lanes))
    return wide, equations.placement(T, wide, in_lanes(motion.q), prescribed)


def in_lanes(x: Tensor) -> Tensor:
    """[lanes, times, n] -> [n, 1, lanes x times]."""
    return x.permute(2, 0, 1).flatten(1)[:, None]


def at_times(motion: MotionData, x: Tensor) -> Tensor:
    """[n, 1, lanes x times] -> [lanes, times, n]."""
    return x[:, 0].unflatten(-1, (motion.lanes, len(motion.t))).permute(1, 2, 0)
