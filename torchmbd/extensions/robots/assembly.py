"""Bodies, joints and forces of a robot file (tree.py).

    revolute, continuous -> Revolute      prismatic -> Prismatic      planar -> Planar      spherical -> Spherical
    floating -> a free body      closures -> Spherical, Fixed between links beside the tree
    fixed -> the child is a part of its parent (its inertia is added), or a Fixed joint beside a flexible body
    a joint that mimics another -> JointCoupling "NAME_mimic"
    limits -> RotationalStop, AxialStop      springs, damping, friction, actuators -> forces.py

A flexible body can replace a link; its mesh is then in the frame of the link. A joint acts on the node set with the name of the
joint, else on the node nearest to the joint's position in the file, by a rigid arm.
Checked in tests/extensions/robots/test_robot.py, test_robot_mjcf.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from torchmbd.errors import InputError, true_or_false, unknown, warn, within
from torchmbd.extensions.robots.forces import MOVING, actuator_forces, identifier, joint_forces
from torchmbd.extensions.robots.tree import IDENTITY, Pose, Robot, RobotJoint, combined_mass
from torchmbd.math.checked_numbers import positive, scalar
from torchmbd.multibody.bodies import FlexibleBody, RigidBody
from torchmbd.multibody.bodies.frame import set_start
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.forces.contact import MOST_TURN, AxialStop, RotationalStop
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.joints import Drive, Fixed, JointCoupling, Planar, Prismatic, Revolute, Spherical
from torchmbd.multibody.joints.joint import Joint, JointCoordinate

FAR = 0.2  # longest arm to the nearest node of a flexible body, as a share of its size
FLAT = 1e-12  # [m2] inertia over mass below which a negative principal value is rounding


class _Placed(NamedTuple):
    """A link in space: its pose, the velocity of its origin and its angular velocity in ground axes."""

    pose: Pose
    velocity: np.ndarray
    spin: np.ndarray


def robot(
    file: Robot,
    flexible: Mapping[str, FlexibleBody],
    fixed_base: bool = True,
    positions: Mapping[str, float] | None = None,
    velocities: Mapping[str, float] | None = None,
    drives: Mapping[str, Any] | None = None,
    locked: Iterable[str] = (),
    stop_stiffness: float | None = 1e4,
    stop_damping: float = 0.0,
    friction_speed: float = 0.01,
    controls: Mapping[str, Any] | None = None,
    gravity: Sequence[float] | None = (0.0, 0.0, -9.81),
) -> dict[str, Any]:
    """Arguments of a System: bodies, joints, forces, free, gravity.

    positions, velocities  initial coordinates of joints by name [rad, m], [rad/s, m/s]; others are zero, or those of the file
    drives                 joint name -> law of the change of its coordinate, a function of time as in mbd.Drive: "NAME_drive"
    locked                 names of joints that are fixed at these positions; those that mimic them are fixed with them
    stop_stiffness         of the stops at joint limits [N m/rad, N/m]; None: no stops, a start may be beyond limits
    stop_damping           of the stops [s/rad, s/m], as in RotationalStop
    controls               actuator name -> control, a number or a torch function of time; others are zero
    friction_speed         speed below which friction decreases to zero [rad/s, m/s]
    gravity                [m/s2]
    """
    fixed_base = true_or_false("fixed_base", fixed_base)
    named = {
        "flexible": flexible,
        "positions": positions,
        "velocities": velocities,
        "drives": drives,
        "controls": controls,
    }
    for key, argument in named.items():
        if argument is not None and not isinstance(argument, Mapping):
            raise InputError(key, argument, "a mapping name -> value")
    names = None if isinstance(locked, str) or not isinstance(locked, Iterable) else list(locked)
    if names is None or not all(isinstance(name, str) for name in names):
        raise InputError("locked", locked, "names of joints")
    builder = _Builder(file, flexible, fixed_base, positions or {}, velocities or {}, drives or {}, set(names))
    if stop_stiffness is not None:
        positive("stop_stiffness", stop_stiffness, "N m/rad or N/m")
        builder.check_limits()
    return builder.parts(stop_stiffness, stop_damping, friction_speed, controls or {}) | {"gravity": gravity}


class _Builder:
    """Makes bodies of links, and joints and forces between them."""

    def __init__(
        self,
        robot: Robot,
        flexible: Any,
        fixed_base: bool,
        positions: Any,
        velocities: Any,
        drives: Mapping[str, Any],
        locked: set[str],
    ) -> None:
        self.flexible, self.drives = dict(flexible), drives
        moving = [joint.name for joint in robot.joints if joint.kind in MOVING]
        unlocked = [name for name in moving if name not in locked]
        for key, keys, allowed in (
            ("flexible", self.flexible, [link for link in robot.links if link != robot.root or not fixed_base]),
            ("positions", positions, moving),
            ("velocities", velocities, unlocked),
            ("drives", drives, unlocked),
            ("locked", sorted(locked), moving),
        ):
            for name in keys:
                if name not in allowed:
                    raise unknown(f"name in {key}", name, allowed, (key, name))
        for link, body in self.flexible.items():
            if not isinstance(body, FlexibleBody):
                raise InputError(("flexible", link), body, "a FlexibleBody", noun=f"flexible[{link!r}]")
        self.q = {name: scalar(f"positions[{name!r}]", x) for name, x in positions.items()}
        self.rate = {name: scalar(f"velocities[{name!r}]", x) for name, x in velocities.items()}
        self.fixed_base = fixed_base
        start = {joint.name: joint.start for joint in robot.joints}
        self.closure_poses = _place(robot.joints, robot.root, start, {})  # the file states closures in this position
        self.requests = {"positions": dict(self.q), "velocities": dict(self.rate)}
        self.q = start | self.q
        immobile = self._follow(robot, locked)
        self.robot = replace(robot, joints=[self._locked(j) if j.name in immobile else j for j in robot.joints])
        self._drop_empty_links()
        names: dict[str, str] = {}
        for joint in self.robot.joints:
            if (first := names.setdefault(identifier(joint.name), joint.name)) != joint.name:
                raise InputError(
                    ("joints", joint.name),
                    allowed="must have different names",
                    state=f"have the same identifier {identifier(joint.name)!r}",
                    noun=f"joints {first!r} and {joint.name!r}",
                )
        self.placed = _place(self.robot.joints, self.robot.root, self.q, self.rate)
        self.owner, self.pose_in_owner = self._owners()
        self.bodies = self._bodies()

    def _follow(self, robot: Robot, locked: set[str]) -> set[str]:
        """Set coordinates and rates of joints that mimic others; return the names of joints that cannot move."""
        joints, immobile, visited = {joint.name: joint for joint in robot.joints}, set(locked), set(locked)

        def follow(name: str, followers: tuple[str, ...]) -> None:
            mimic = joints[name].mimics
            if name in followers:
                raise InputError(
                    ("joints", name),
                    hint=f"locked={[name]!r}",
                    noun=f"joints {[*followers, name]}",
                    state="mimic each other in a loop",
                )
            if mimic is None or name in visited:
                return
            for x in (name, mimic.joint) if mimic.joint else (name,):
                if x not in joints or joints[x].kind not in MOVING:
                    raise InputError(
                        ("joints", name),
                        hint=f"locked={[name]!r}",
                        noun=f"joint {name!r}",
                        state=f"mimics {mimic.joint!r}",
                        allowed="revolute, continuous or prismatic, as the other joint must be",
                    )
            if mimic.joint:
                follow(mimic.joint, (*followers, name))
            still = not mimic.joint or mimic.ratio == 0.0 or mimic.joint in immobile
            immobile.update([name] if still else [])
            leader = self.q[mimic.joint] if mimic.joint else 0.0
            self.q[name] = self._consistent("positions", name, mimic.offset + mimic.ratio * leader, mimic.joint)
            rate = 0.0 if still else mimic.ratio * self.rate.get(mimic.joint, 0.0)
            if self._consistent("velocities", name, rate, mimic.joint):
                self.rate[name] = rate
            visited.add(name)

        for name in joints:
            follow(name, ())
        return immobile

    def _consistent(self, key: str, name: str, x: float, leader: str) -> float:
        """x; InputError if a caller asks for another position or velocity of a joint that mimics another."""
        value = self.requests[key].get(name, x)
        reason = f"it mimics {leader!r}" if leader else "the file holds it"
        if abs(value - x) > 1e-9 * max(1.0, abs(x)):
            raise InputError(
                (key, name),
                value,
                f"{x:g}, because {reason}",
                shown=f"{value:g}",
                noun=f"{key}[{name!r}]",
                hint=f"{key} without it",
            )
        return x

    def _locked(self, joint: RobotJoint) -> RobotJoint:
        origin = joint.origin @ joint.displaced(self.q[joint.name])
        return replace(joint, kind="fixed", origin=origin, limits=None, mimics=None)

    def _drop_empty_links(self) -> None:
        """Leave out links without mass and inertia that are fixed to others and carry none, such as flanges."""
        kept: list[RobotJoint] = []
        for joint in reversed(self.robot.joints):
            link = self.robot.links[joint.child]
            empty = link.mass == 0.0 and not link.inertia.any()
            droppable = joint.kind == "fixed" and empty and joint.child not in self.flexible
            if not droppable or any(other.parent == joint.child for other in kept):
                kept.append(joint)
        self.robot = replace(self.robot, joints=kept[::-1])

    def check_limits(self) -> None:
        """InputError if joints start beyond their limits, as stops would have large forces there."""
        beyond = {}
        for joint in self.robot.joints:
            q = self.q[joint.name]
            if joint.limits is not None and not joint.limits[0] <= q <= joint.limits[1]:
                beyond[joint.name] = f"{joint.name!r} at {q:g}, from {joint.limits[0]:g} to {joint.limits[1]:g}"
        if beyond:
            raise InputError(
                "positions",
                allowed="between these",
                state=f"have joints beyond their limits ({'; '.join(beyond.values())})",
                noun="positions",
                hint="stop_stiffness=None",
            )

    def _owners(self) -> tuple[dict[str, str], dict[str, Pose]]:
        """For each link the link whose body it is a part of, and its pose in that; links fixed to rigid links are parts."""
        owner, pose = {self.robot.root: self.robot.root}, {self.robot.root: IDENTITY}
        for joint in self.robot.joints:
            parent = owner[joint.parent]
            if joint.kind == "fixed" and not {parent, joint.child} & self.flexible.keys():
                owner[joint.child], pose[joint.child] = parent, pose[joint.parent] @ joint.origin
            else:
                owner[joint.child], pose[joint.child] = joint.child, IDENTITY
        return owner, pose

    def _bodies(self) -> dict[str, Any]:
        """Bodies by their links; the ground for a fixed root."""
        bodies: dict[str, Any] = {}
        self.impossible: list[str] = []
        for link in dict.fromkeys(self.owner.values()):
            at = self.placed[link]
            if link == self.robot.root and self.fixed_base:
                bodies[link] = Ground()
            elif link in self.flexible:
                body = self.flexible[link]
                arm = at.pose.axes @ body.origin.detach().numpy()
                velocity = at.velocity + np.cross(at.spin, arm)
                set_start(body, (at.pose.position + arm).tolist(), at.pose.axes.tolist())
                if self.rate:
                    body.moving(velocity.tolist(), (at.pose.axes.T @ at.spin).tolist())
                bodies[link] = body
            else:
                bodies[link] = self._rigid(link, at)
        if self.impossible:
            warn(
                f"links {self.impossible}: the largest principal inertia exceeds the sum of the other two, which is "
                "physically impossible; the reader keeps it nevertheless"
            )
        return bodies

    def _rigid(self, link: str, at: _Placed) -> RigidBody:
        """The rigid body of a link and of those that are parts of it."""
        parts = []
        for name in [name for name, owner in self.owner.items() if owner == link]:
            part, pose = self.robot.links[name], self.pose_in_owner[name]
            parts.append((part.mass, pose.position + pose.axes @ part.center, pose.axes @ part.inertia @ pose.axes.T))
        mass, center, J = combined_mass(parts)
        if not mass > 0.0:
            raise InputError(
                ("links", link),
                allowed="must have a positive mass, because it moves",
                state="is fixed to it, has no mass",
                noun=f"link {link!r}, with what",
            )
        J, possible = _physical(link, J, mass)
        speed = [at.velocity.tolist(), (at.pose.axes.T @ at.spin).tolist()] if self.rate else [None, None]
        inertia = J if possible else np.trace(J) / 3.0 * np.eye(3)
        try:
            body = RigidBody(
                identifier(link),
                mass,
                inertia.tolist(),
                center.tolist(),
                at.pose.position.tolist(),
                at.pose.axes.tolist(),
                *speed,
            )
        except InputError as error:
            raise within(f"link {link!r}", error, "links", link) from None
        if not possible:
            body.inertia.copy_(torch.from_numpy(J))
            self.impossible.append(link)
        return body

    def parts(
        self, stop_stiffness: float | None, stop_damping: float, friction_speed: float, controls: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Bodies, joints, forces, and the names of free bodies."""
        joints: list[Joint] = []
        forces: list[ForceElement] = []
        root = self.bodies[self.robot.root]
        free = [] if self.fixed_base else [root.name]
        unlimited = []
        ends: dict[str, Any] = {}
        coordinates: dict[str, JointCoordinate] = {}
        for joint in self.robot.joints:
            if self.owner[joint.child] != joint.child:
                continue
            name, axes = identifier(joint.name), _triad(joint.axis)
            pose = Pose(joint.anchor, axes)
            a = self._frame(joint.parent, joint.name, joint.origin @ pose)
            b = self._frame(joint.child, joint.name, pose)
            if joint.kind in MOVING:
                ends[joint.name] = joint, a, b
            if joint.kind in ("revolute", "continuous"):
                joints.append(hinge := Revolute(a, b, axis="z", name=name))
                coordinates[joint.name] = hinge.angle
            elif joint.kind == "prismatic":
                joints.append(slide := Prismatic(a, b, axis="z", name=name))
                coordinates[joint.name] = slide.travel
            elif joint.kind == "planar":
                joints.append(Planar(a, b, normal="z", name=name))
            elif joint.kind == "spherical":
                joints.append(Spherical(a, b, name=name))
            elif joint.kind == "fixed":
                joints.append(Fixed(a, b, name=name))
            else:
                free.append(self.bodies[joint.child].name)
            if joint.name in self.drives:
                law: Any = {"position" if joint.kind == "prismatic" else "angle": self.drives[joint.name]}
                joints.append(Drive(a, b, axis="z", **law, name=f"{name}_drive"))
            forces += joint_forces(joint, a, b, friction_speed)
            if joint.limits is None or stop_stiffness is None:
                continue
            if joint.kind == "revolute" and joint.limits[1] - joint.limits[0] > MOST_TURN:
                unlimited.append(joint.name)
                continue
            stop = AxialStop if joint.kind == "prismatic" else RotationalStop
            lower, upper = joint.limits
            options = {"lower": lower, "upper": upper, "stiffness": stop_stiffness, "damping": stop_damping}
            forces.append(stop(a, b, "z", **options, name=f"{name}_stop"))
        if unlimited:
            warn(f"limits of joints {unlimited} are about one full turn apart, or more; the reader leaves them out")
        for joint in self.robot.joints:
            if (mimic := joint.mimics) is not None:
                pair = coordinates[joint.name], coordinates[mimic.joint]
                joints.append(JointCoupling(pair, [1.0, -mimic.ratio], name=f"{identifier(joint.name)}_mimic"))
        forces += actuator_forces(self.robot.actuators, ends, controls)
        for closure in self.robot.closures:
            first, second = (self.closure_poses[link].pose for link in closure.links)
            pose = Pose(closure.position, np.eye(3))
            poses = pose, second.inverse @ first @ pose
            a, b = (self._frame(*pair) for pair in zip(closure.links, (closure.name,) * 2, poses, strict=True))
            joints.append((Fixed if closure.kind == "fixed" else Spherical)(a, b, name=identifier(closure.name)))
        bodies = [body for body in self.bodies.values() if not isinstance(body, Ground)]
        return {"bodies": bodies, "joints": joints, "forces": forces, "free": free}

    def _frame(self, link: str, joint: str, pose: Pose) -> Any:
        """The frame of a joint at a pose in a link, on the body that the link is a part of, or on a flexible body."""
        pose = self.pose_in_owner[link] @ pose
        body = self.bodies[self.owner[link]]
        if not isinstance(body, FlexibleBody):
            x, y, z = pose.position.tolist()
            return body.at(x, y, z, axes=pose.axes.tolist())
        nodes = body.mesh.nodes.detach().numpy()
        named = joint in body.mesh.node_sets
        members = (
            list(body.mesh.node_sets[joint]) if named else [int(np.linalg.norm(nodes - pose.position, axis=1).argmin())]
        )
        arm = pose.position - nodes[members].mean(0)
        size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        if np.linalg.norm(arm) > FAR * size:
            raise InputError(
                str(joint),
                np.linalg.norm(arm),
                f"at most {FAR * size:.3g} m away from them",
                noun=f"joint {joint!r}",
                state=f"is {np.linalg.norm(arm):.3g} m away from {('its nodes' if named else 'the nearest node')} "
                f"of {body.name!r}",
                hint="a mesh in the frame of the link",
            )
        return body.at(joint if named else members[0], axes=pose.axes.tolist(), offset=arm.tolist())


def _place(
    joints: Sequence[RobotJoint], root: str, positions: Mapping[str, float], velocities: Mapping[str, float]
) -> dict[str, _Placed]:
    """Poses and velocities of all links by name, out of coordinates and rates of the joints."""
    placed = {root: _Placed(IDENTITY, np.zeros(3), np.zeros(3))}
    for joint in joints:
        base, rate = placed[joint.parent], velocities.get(joint.name, 0.0)
        start = base.pose @ joint.origin
        axis = start.axes @ joint.axis * rate
        slides = joint.kind == "prismatic"
        pose = start @ joint.displaced(positions[joint.name])
        spin = base.spin if slides else base.spin + axis
        velocity = base.velocity + np.cross(base.spin, pose.position - base.pose.position)
        velocity += axis if slides else np.cross(axis, -pose.axes @ joint.anchor)
        placed[joint.child] = _Placed(pose, velocity, spin)
    return placed


def _physical(link: str, J: np.ndarray, mass: float) -> tuple[np.ndarray, bool]:
    """J without negative principal values by rounding, and whether a mass can have it; InputError if J is negative."""
    values, axes = np.linalg.eigh(J)
    if values[0] < -FLAT * mass - 1e-9 * values[2]:
        raise InputError(
            ("links", link, "inertia"),
            allowed="must have principal values that are zero or positive",
            state=f"has the principal values {values.tolist()}",
            noun=f"inertia of link {link!r}",
        )
    if values[0] < 0.0:
        values = values.clip(0.0)
        J = (axes * values) @ axes.T
    return J, bool(values[0] + values[1] >= values[2] * (1.0 - 1e-12))


def _triad(axis: np.ndarray) -> np.ndarray:
    """A triad (columns) whose z is the axis; the axes of the link where the axis is its z."""
    if abs(axis[2] - 1.0) < 1e-12:
        return np.eye(3)
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
