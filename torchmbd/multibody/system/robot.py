"""A robot of a URDF file (io/urdf.py) as bodies, joints and forces.

    revolute, continuous -> Revolute      prismatic -> Prismatic      planar -> Planar      floating -> a free body
    fixed -> the child is a part of its parent (its inertia is added), or a Fixed joint beside a flexible body
    limits -> stops (Gap), damping -> -c s', friction -> -f tanh(s' / friction_speed)

A flexible body takes the place of a link: its mesh is in the frame of the link. A joint sits on the node set that has the
name of the joint, else on the node next to the place that the file says, by a rigid arm.
Checked in tests/multibody/system/test_robot.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchmbd.errors import InputError, unknown, warn
from torchmbd.io.urdf import Pose, Robot, UrdfJoint, read_urdf
from torchmbd.math.owned import positive, scalar
from torchmbd.multibody.bodies import FlexibleBody, RigidBody
from torchmbd.multibody.bodies.frame import put
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.forces.laws import Friction, Gap, Spring
from torchmbd.multibody.forces.spring_damper import AxialSpringDamper, RotationalSpringDamper
from torchmbd.multibody.joints import Fixed, Planar, Prismatic, Revolute
from torchmbd.multibody.joints.joint import Joint

ROUND = 2.0 * math.pi - 0.2  # limits further apart than this are no stops: an angle is known up to a turn
FAR = 0.2  # of the size of a flexible body: how long the arm to its nearest node may be
_STAND = Pose(np.zeros(3), np.eye(3))


class _Placed(NamedTuple):
    """A link in space: its pose, the velocity of its origin and its angular velocity in ground axes."""

    pose: Pose
    velocity: np.ndarray
    spin: np.ndarray


def robot(
    path: str | Path,
    flexible: Mapping[str, FlexibleBody],
    fixed_base: bool = True,
    positions: Mapping[str, float] | None = None,
    velocities: Mapping[str, float] | None = None,
    stop_stiffness: float | None = 1e4,
    friction_speed: float = 0.01,
    gravity: Sequence[float] | None = (0.0, 0.0, -9.81),
) -> dict[str, Any]:
    """What a System takes: bodies, joints, forces, free, gravity.

    positions, velocities  initial coordinates of joints by name [rad, m], [rad/s, m/s]; others are zero
    stop_stiffness         of the stops at joint limits [N m/rad, N/m]; None: joints without stops
    friction_speed         below it friction falls off [rad/s, m/s]
    gravity                [m/s2]
    """
    if not isinstance(fixed_base, bool):
        raise InputError(f"fixed_base is {fixed_base!r}; allowed: True or False")
    for key, given in (("flexible", flexible), ("positions", positions), ("velocities", velocities)):
        if given is not None and not isinstance(given, Mapping):
            raise InputError(f"{key} is {given!r}; allowed: names -> values")
    made = _Builder(read_urdf(path), flexible, fixed_base, positions or {}, velocities or {})
    return made.parts(stop_stiffness, friction_speed) | {"gravity": gravity}


class _Builder:
    """Bodies of links and what is between them."""

    def __init__(self, robot: Robot, flexible: Any, fixed_base: bool, positions: Any, velocities: Any) -> None:
        self.robot, self.flexible = robot, dict(flexible)
        moving = [joint.name for joint in robot.joints if joint.kind in ("revolute", "continuous", "prismatic")]
        for key, given, allowed in (
            ("flexible", self.flexible, [link for link in robot.links if link != robot.root or not fixed_base]),
            ("positions", positions, moving),
            ("velocities", velocities, moving),
        ):
            for name in given:
                if name not in allowed:
                    raise unknown(f"{key}:", name, allowed)
        for link, body in self.flexible.items():
            if not isinstance(body, FlexibleBody):
                raise InputError(f"flexible[{link!r}] is {body!r}; allowed: a FlexibleBody")
        self.q = {name: scalar(f"positions[{name!r}]", x) for name, x in positions.items()}
        self.rate = {name: scalar(f"velocities[{name!r}]", x) for name, x in velocities.items()}
        self.fixed_base = fixed_base
        self.placed = self._place()
        self.owner, self.inside = self._owners()
        self.bodies = self._bodies()

    def _place(self) -> dict[str, _Placed]:
        placed = {self.robot.root: _Placed(_STAND, np.zeros(3), np.zeros(3))}
        for joint in self.robot.joints:
            base, q, rate = placed[joint.parent], self.q.get(joint.name, 0.0), self.rate.get(joint.name, 0.0)
            own = base.pose @ joint.origin
            axis = own.axes @ joint.axis
            slides = joint.kind == "prismatic"
            turned = Pose(joint.axis * q, np.eye(3)) if slides else Pose(np.zeros(3), _rotation(joint.axis, q))
            pose = own @ turned
            spin = base.spin if slides else base.spin + axis * rate
            velocity = (
                base.velocity + np.cross(base.spin, pose.place - base.pose.place) + (axis * rate if slides else 0.0)
            )
            placed[joint.child] = _Placed(pose, velocity, spin)
        return placed

    def _owners(self) -> tuple[dict[str, str], dict[str, Pose]]:
        """The link that each link is a part of, and its pose there: those fixed to others are parts of them."""
        owner, inside = {self.robot.root: self.robot.root}, {self.robot.root: _STAND}
        for joint in self.robot.joints:
            parent = owner[joint.parent]
            if joint.kind == "fixed" and not {parent, joint.child} & self.flexible.keys():
                owner[joint.child], inside[joint.child] = parent, inside[joint.parent] @ joint.origin
            else:
                owner[joint.child], inside[joint.child] = joint.child, _STAND
        return owner, inside

    def _bodies(self) -> dict[str, Any]:
        """Bodies by their links; the ground in the place of a root that is fixed."""
        bodies: dict[str, Any] = {}
        for link in dict.fromkeys(self.owner.values()):
            at = self.placed[link]
            if link == self.robot.root and self.fixed_base:
                bodies[link] = Ground()
            elif link in self.flexible:
                body = self.flexible[link]
                arm = at.pose.axes @ body.origin.detach().numpy()
                velocity = at.velocity + np.cross(at.spin, arm)
                put(body, (at.pose.place + arm).tolist(), at.pose.axes.tolist())
                if self.rate:
                    body.moving(velocity.tolist(), (at.pose.axes.T @ at.spin).tolist())
                bodies[link] = body
            else:
                bodies[link] = self._rigid(link, at)
        return bodies

    def _rigid(self, link: str, at: _Placed) -> RigidBody:
        members = [name for name, own in self.owner.items() if own == link]
        mass = sum(self.robot.links[name].mass for name in members)
        if not mass > 0.0:
            raise InputError(f"link {link!r}, with what is fixed to it, has no mass; allowed: a mass > 0 of what moves")
        centers, inertias = {}, {}
        for name in members:
            own, pose = self.robot.links[name], self.inside[name]
            centers[name] = pose.place + pose.axes @ own.center
            inertias[name] = pose.axes @ own.inertia @ pose.axes.T
        center = np.sum([self.robot.links[name].mass * centers[name] for name in members], axis=0) / mass
        J = np.zeros((3, 3))
        for name in members:
            d = centers[name] - center
            J += inertias[name] + self.robot.links[name].mass * (d @ d * np.eye(3) - np.outer(d, d))
        speed = [at.velocity.tolist(), (at.pose.axes.T @ at.spin).tolist()] if self.rate else [None, None]
        try:
            return RigidBody(
                _identifier(link),
                mass,
                J.tolist(),
                center.tolist(),
                at.pose.place.tolist(),
                at.pose.axes.tolist(),
                *speed,
            )
        except InputError as error:
            raise InputError(f"link {link!r}: {error}") from None

    def parts(self, stop_stiffness: float | None, friction_speed: float) -> dict[str, Any]:
        joints: list[Joint] = []
        forces: list[ForceElement] = []
        root = self.bodies[self.robot.root]
        free = [] if self.fixed_base else [root.name]
        for joint in self.robot.joints:
            if self.owner[joint.child] != joint.child:
                continue
            name, axes = _identifier(joint.name), _triad(joint.axis)
            pose = self.inside[joint.parent] @ joint.origin
            a = self._frame(self.owner[joint.parent], joint, Pose(pose.place, pose.axes @ axes))
            b = self._frame(joint.child, joint, Pose(np.zeros(3), axes))
            if joint.kind in ("revolute", "continuous"):
                joints.append(Revolute(a, b, axis="z", name=name))
            elif joint.kind == "prismatic":
                joints.append(Prismatic(a, b, axis="z", name=name))
            elif joint.kind == "planar":
                joints.append(Planar(a, b, normal="z", name=name))
            elif joint.kind == "fixed":
                joints.append(Fixed(a, b, name=name))
            else:
                free.append(self.bodies[joint.child].name)
            forces += _forces(joint, a, b, stop_stiffness, friction_speed)
        bodies = [body for body in self.bodies.values() if not isinstance(body, Ground)]
        return {"bodies": bodies, "joints": joints, "forces": forces, "free": free}

    def _frame(self, link: str, joint: UrdfJoint, pose: Pose) -> Any:
        """Frame of a link, also one of a flexible body."""
        body = self.bodies[link]
        if not isinstance(body, FlexibleBody):
            x, y, z = pose.place.tolist()
            return body.at(x, y, z, axes=pose.axes.tolist())
        nodes = body.mesh.nodes.detach().numpy()
        named = joint.name in body.mesh.node_sets
        members = (
            list(body.mesh.node_sets[joint.name])
            if named
            else [int(np.linalg.norm(nodes - pose.place, axis=1).argmin())]
        )
        arm = pose.place - nodes[members].mean(0)
        size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        if np.linalg.norm(arm) > FAR * size:
            raise InputError(
                f"joint {joint.name!r} is {np.linalg.norm(arm):.3g} m away from {'its nodes' if named else 'the nearest node'} "
                f"of {body.name!r}; allowed: {FAR * size:.3g} m, a mesh in the frame of the link"
            )
        return body.at(joint.name if named else members[0], axes=pose.axes.tolist(), offset=arm.tolist())


def _forces(joint: UrdfJoint, a: Any, b: Any, stop_stiffness: float | None, speed: float) -> list[ForceElement]:
    """Damping, friction and stops of a joint."""
    if joint.kind not in ("revolute", "continuous", "prismatic"):
        return []
    name, turns = _identifier(joint.name), joint.kind != "prismatic"
    kind = RotationalSpringDamper if turns else AxialSpringDamper
    lower, upper = joint.limits or (0.0, 0.0)
    center = 0.5 * (lower + upper) if turns else 0.0
    laws: dict[str, Any] = {}
    if joint.damping:
        laws["damping"] = Spring(damping=joint.damping)
    if joint.friction:
        laws["friction"] = Friction(joint.friction, positive("friction_speed", speed, "rad/s or m/s"))
    if joint.limits and turns and upper - lower > ROUND:
        warn(f"limits of joint {joint.name!r} are {upper - lower:.4g} rad apart, about a turn: they are left out")
    elif joint.limits and stop_stiffness is not None:
        stiffness = positive("stop_stiffness", stop_stiffness, "N m/rad or N/m")
        laws["lower"] = Gap(stiffness, lower, 1.0, center=center)
        laws["upper"] = Gap(stiffness, upper, -1.0, center=center)
    return [kind(a, b, axis="z", law=law, name=f"{name}_{key}") for key, law in laws.items()]


def _identifier(name: str) -> str:
    made = "".join(c if c.isalnum() or c == "_" else "_" for c in name)
    return made if made.isidentifier() else f"_{made}"


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K


def _triad(axis: np.ndarray) -> np.ndarray:
    """Columns of a triad whose z is the axis; the axes of the link where that is its z."""
    if abs(axis[2] - 1.0) < 1e-12:
        return np.eye(3)
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
