"""Histories of a motion: strain energy, positions and rates of points, reactions.

    StrainEnergy            U = 1/2 w' Kr w                                                    [J]   eq. (17)
    Position                of a point, seen from a body or the ground                          [m]
    Displacement            change of position since the start; of a flexible body seen from itself: elastic
    Velocity, Acceleration  rates of the position as the observer sees it                       [m/s], [m/s2]
    RelativeDisplacement    u_a - u_b of two nodes of a body: local torsion, eq. (38)           [m]
    Reaction                force or torque that a joint exerts on a body                       [N], [N m]

A history of a vector has one component of it: along "x", "y", "z" or a direction of three numbers, in the axes of the observer
or of another body (`axes`). Seen from a body with rotation A and origin r, a point g is at y = A'(g - r), and

    y' = A'(g - r)' - om x y          y'' = A'(g - r)'' - om x (A'(g - r)' + y') - om' x y

Rates by time are exact except of velocities, accelerations, reactions and components in axes of another body: there they
come from differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.design.response import History
from torchmbd.errors import InputError, unknown, warn
from torchmbd.integrate import Trajectory
from torchmbd.math.lane_groups import by_groups
from torchmbd.multibody.bodies import FlexibleBeam, FlexibleBody, Ground
from torchmbd.multibody.joints import Cylindrical, Prismatic, Revolute, Spherical
from torchmbd.multibody.joints.joint import Joint
from torchmbd.multibody.joints.lock import freedoms
from torchmbd.multibody.system import System
from torchmbd.results.beam_motion import BeamMotion
from torchmbd.results.reaction import frame_point, joint_named, reaction_on
from torchmbd.results.ringing import warn_of_ringing

GROUND = "ground"
_ALONG = 1e-9  # of a unit vector: rounding of axes
Direction = str | Sequence[float]


@dataclass(frozen=True)
class StrainEnergy(History):
    """Elastic energy of a flexible body, of a linear one U = 1/2 w' Kr w, or of a flexible beam [lanes, times] [J]; eq. (17).

    body  its name

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> mbd.StrainEnergy("arm")(motion).shape
    torch.Size([1, 41])
    """

    body: str

    def check(self, system: System) -> None:
        elastic_body(system, self.body)

    def values(self, motion: Trajectory) -> Tensor:
        return motion.body(self.body).strain_energy

    def rates(self, motion: Trajectory) -> tuple[Tensor, Tensor] | None:
        body = motion.body(self.body)
        if isinstance(body, BeamMotion):
            return None
        bent, tensors = body.bent_stiffness, (body.stiffness[0], body.w, body.wd, body.wdd)
        first, second = by_groups(_energy_rates, *tensors, *([] if bent is None else [bent]))
        return first, second


def _energy_rates(Kr: Tensor, w: Tensor, wd: Tensor, wdd: Tensor, bent: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """First and second rate [lanes, times] of the strain energy."""
    force, stiff = w @ Kr, wd @ Kr
    if bent is not None:
        force, stiff = force + 0.5 * (bent @ w[..., None])[..., 0], stiff + (bent @ wd[..., None])[..., 0]
    return (force * wd).sum(-1), (stiff * wd + force * wdd).sum(-1)


@dataclass(frozen=True)
class Position(History):
    """Component of the position of a point [lanes, times] [m].

    body       the body of the point
    axis       "x", "y", "z" or a direction of three numbers
    node       mesh node of a flexible body or beam, by name or index; default: the origin of the body frame, the first node
    point      position on a rigid body, in body axes [m]
    seen_from  the observer: a body or "ground"
    axes       the body whose axes the component refers to; default: the observer

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> height = mbd.Position("bob", "y")
    >>> height(motion).shape
    torch.Size([1, 51])
    >>> height(motion)[0, 0].item()
    -1.0
    """

    body: str
    axis: Direction
    node: str | int | None = None
    point: Sequence[float] | None = None
    seen_from: str | None = None
    axes: str | None = None
    order: ClassVar[int] = 0

    @property
    def natural_zero(self) -> bool:
        return self.order > 0  # a position has an origin

    @property
    def observer(self) -> str:
        """The observer: a body or "ground"."""
        return GROUND if self.seen_from is None else self.seen_from

    def check(self, system: System) -> None:
        unit_vector(self.axis)
        body = system.body(self.body)
        if self.node is not None:
            elastic_body(system, self.body).at(self.node)
        if self.point is not None and isinstance(body, FlexibleBody | FlexibleBeam):
            raise InputError(
                "point",
                self.point,
                "None",
                state=f"is {self.point!r} on the flexible body {self.body!r}",
                hint="node=..., which names a node",
            )
        for name in (self.observer, self.axes):
            if name not in (None, GROUND):
                system.body(name)

    def values(self, motion: Trajectory) -> Tensor:
        return vector_component(motion, self.vector(motion), self.axis, self.observer, self.axes)

    def rates(self, motion: Trajectory) -> tuple[Tensor, Tensor] | None:
        if self.order or self.axes not in (None, self.observer):
            return None  # third rates, and rates of other axes, are not available
        _, rate, second_rate = (x @ unit_vector(self.axis) for x in self._seen(motion))
        return rate, second_rate

    def vector(self, motion: Trajectory) -> Tensor:
        """The vector [lanes, times, 3] in the axes of the observer."""
        if self.observer == GROUND:  # rates are not needed
            return getattr(self._point(motion), ("position", "velocity", "acceleration")[self.order])
        return self._seen(motion)[self.order]

    def _point(self, motion: Trajectory) -> Any:
        """The point in this motion (results/body_motion.py)."""
        return motion.body(self.body).at(self.point if self.node is None else self.node)

    def _seen(self, motion: Trajectory) -> tuple[Tensor, Tensor, Tensor]:
        """Position, velocity and acceleration of the point relative to the observer, in its axes [lanes, times, 3]."""
        point = self._point(motion)
        if self.observer == self.body and not isinstance(motion.body(self.body), BeamMotion):
            return point.rho, point.rho_rate, point.rho_acceleration
        jets = point.position, point.velocity, point.acceleration
        if self.observer == GROUND:
            return jets
        body = motion.body(self.observer)
        origin = body.at()
        origin_jets = origin.position, origin.velocity, origin.acceleration
        y, yd, ydd = (torch.einsum("ltji,ltj->lti", body.A, g - r) for g, r in zip(jets, origin_jets, strict=True))
        rate = yd - _cross(body.omega, y)
        return y, rate, ydd - _cross(body.omega, yd + rate) - _cross(body.omega_rate, y)


@dataclass(frozen=True)
class Displacement(Position):
    """Change of position since the start [lanes, times] [m]; arguments as in `Position`.

    If a node is given, the default observer is the body itself: the elastic displacement. Otherwise it is the ground.

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> elastic = mbd.Displacement("arm", "z", node="right")
    >>> total = mbd.Displacement("arm", "y", node="right", seen_from="ground")
    >>> [round(1e3 * mbd.Final(h)(motion).item()) for h in (elastic, total)]  # [mm]
    [1, -51]
    """

    def check(self, system: System) -> None:
        super().check(system)
        if self.observer == self.body and self.node is None:
            raise InputError(
                "seen_from",
                self.body,
                "must have a node, or seen_from",
                state="is zero",
                noun=f"displacement of the origin of {self.body!r} seen from itself",
            )
        body = system.body(self.body)
        if self.observer == self.body and self.node is not None and isinstance(body, FlexibleBody):
            frame = body.at(self.node).interpolation
            if frame is not None and set(frame.nodes) <= set(body.reference):
                warn(
                    f"the displacement of node {self.node!r} of {self.body!r} is zero at all times, because the body frame is "
                    "fixed to this node. Try: seen_from='ground', another node, or another reference of the body"
                )

    @property
    def observer(self) -> str:
        """The observer: a body or "ground"."""
        return self.seen_from or (self.body if self.node is not None else GROUND)

    @property
    def natural_zero(self) -> bool:
        return True

    @property
    def since_start(self) -> bool:
        return self.node is None or self.observer != self.body

    def vector(self, motion: Trajectory) -> Tensor:
        if not self.since_start:
            return motion.body(self.body).at(self.node).displacement
        y = super().vector(motion)
        return y - y[:, :1]


@dataclass(frozen=True)
class Velocity(Position):
    """Rate of the position as the observer sees it [lanes, times] [m/s]; arguments as in `Position`.

    >>> motion = mbd.simulate(mbd.examples.pendulum(speed=2.0), 0.1, steps=10)
    >>> mbd.Velocity("bob", "x")(motion)[0, 0].item()
    2.0
    """

    order: ClassVar[int] = 1


@dataclass(frozen=True)
class Acceleration(Position):
    """Second rate of the position as the observer sees it [lanes, times] [m/s2]; arguments as in `Position`.

    >>> motion = mbd.simulate(mbd.examples.pendulum(length=0.5, speed=2.0), 0.1, steps=10)
    >>> round(mbd.Acceleration("bob", "y")(motion)[0, 0].item(), 6)  # v^2 / length
    8.0
    """

    order: ClassVar[int] = 2


@dataclass(frozen=True)
class RelativeDisplacement(History):
    """Elastic displacement of node a minus that of node b [lanes, times] [m]; axis "z" of a plate: the local torsion, eq. (38).

    body  the flexible body
    a, b  its nodes, by name or index
    axis  "x", "y", "z" or a direction of three numbers
    axes  whose axes the component is in: a body or "ground"; default: the body's own

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> twist = mbd.RelativeDisplacement("arm", "corner_right_top", "corner_right_bottom", "z")
    >>> twist(motion).shape
    torch.Size([1, 41])
    """

    body: str
    a: str | int
    b: str | int
    axis: Direction
    axes: str | None = None

    def check(self, system: System) -> None:
        unit_vector(self.axis)
        for node in (self.a, self.b):
            flexible_body(system, self.body).at(node)
        if self.axes not in (None, GROUND):
            system.body(self.axes)

    def values(self, motion: Trajectory) -> Tensor:
        body = motion.body(self.body)
        u = body.at(self.a).displacement - body.at(self.b).displacement
        return vector_component(motion, u, self.axis, self.body, self.axes)

    def rates(self, motion: Trajectory) -> tuple[Tensor, Tensor] | None:
        if self.axes not in (None, self.body):
            return None
        a, b = (motion.body(self.body).at(node) for node in (self.a, self.b))
        rates = (a.rho_rate - b.rho_rate, a.rho_acceleration - b.rho_acceleration)
        first, second = (x @ unit_vector(self.axis) for x in rates)
        return first, second


@dataclass(frozen=True)
class Reaction(History):
    """Force of a joint on one of its bodies, or torque about the point of the joint: one component [lanes, times].

    joint  name of the joint
    axis   "x", "y", "z" or a direction of three numbers
    kind   "force" [N] or "torque" [N m]
    on     the body; default: the joint's second
    axes   a body, or "ground" (default)

    >>> motion = mbd.simulate(mbd.examples.pendulum(length=1.0, speed=1.0), 0.1, steps=10)
    >>> round(mbd.Reaction("hinge", "y")(motion)[0, 0].item(), 2)  # m (g + v^2 / length) [N]
    10.81
    """

    joint: str
    axis: Direction
    kind: str = "force"
    on: str | None = None
    axes: str | None = None

    def check(self, system: System) -> None:
        unit_vector(self.axis)
        joint = joint_named(system, self.joint)
        if self.kind not in ("force", "torque"):
            raise unknown("kind", self.kind, ("force", "torque"))
        bodies = tuple(dict.fromkeys(frame.body.name for frame in joint.frames))
        if self.on is not None and self.on not in bodies:
            raise unknown((self.joint, "body"), self.on, bodies)
        if self.axes not in (None, GROUND):
            system.body(self.axes)
        elif _is_free(joint, self.axis, self.kind):
            warn(
                f"the {self.kind} of joint {self.joint!r} along {self.axis!r} is zero at all times, because this joint leaves "
                "this motion free (a phase may lock it). Try: the reaction of a drive, or another axis"
            )

    def values(self, motion: Trajectory) -> Tensor:
        joint = joint_named(motion.system, self.joint)
        side = next((x for x in (joint.b, *joint.frames) if self.on in (None, x.body.name)), joint.b)
        force, torque = reaction_on(motion, joint, side, frame_point(motion, side))
        load = force if self.kind == "force" else torque
        warn_of_ringing(motion, self.joint, self.kind, load)
        return vector_component(motion, load, self.axis, GROUND, self.axes)


def _is_free(joint: Joint, axis: Direction, kind: str) -> bool:
    """True if a joint of the ground leaves the motion along an axis of the ground free, or the rotation about it."""
    if not isinstance(joint, Revolute | Prismatic | Cylindrical | Spherical) or not isinstance(joint.a.body, Ground):
        return False
    free = {k % 3 for k in freedoms(joint) if (k >= 3) == (kind == "torque")}
    along = joint.a.axes.T @ unit_vector(axis)
    return bool(free) and all(abs(float(x)) < _ALONG for k, x in enumerate(along) if k not in free)


def vector_component(motion: Trajectory, x: Tensor, axis: Direction, observer: str, axes: str | None) -> Tensor:
    """Component [lanes, times] of a vector x [lanes, times, 3] in the observer's axes, along an axis of the body `axes`."""
    if axes not in (None, observer):
        if observer != GROUND:
            x = torch.einsum("ltij,ltj->lti", motion.body(observer).A, x)
        if axes != GROUND:
            x = torch.einsum("ltji,ltj->lti", motion.body(axes).A, x)
    return x @ unit_vector(axis)


def unit_vector(axis: Direction) -> Tensor:
    """Unit vector [3] along an axis "x", "y", "z" or a direction of three numbers."""
    if isinstance(axis, str) and axis in ("x", "y", "z"):
        return torch.eye(3, dtype=torch.float64)["xyz".index(axis)]
    try:
        vector = torch.tensor([] if isinstance(axis, str) else [float(x) for x in axis], dtype=torch.float64)
    except (TypeError, ValueError):
        vector = torch.zeros(0, dtype=torch.float64)
    if vector.shape != (3,) or not 0.0 < float(vector.norm()) < float("inf"):
        raise InputError("axis", axis, "'x', 'y', 'z', or a direction of three numbers")
    return vector / vector.norm()


def flexible_body(system: System, name: str) -> FlexibleBody:
    """The flexible body of that name; InputError for a rigid one."""
    body = system.body(name)
    if not isinstance(body, FlexibleBody):
        flexible = [other.name for other in system.bodies if isinstance(other, FlexibleBody)]
        allowed = flexible or "flexible, and the system has no flexible body"
        raise InputError(name, allowed=allowed, noun=f"body {name!r}", state="is rigid")
    return body


def elastic_body(system: System, name: str) -> FlexibleBody | FlexibleBeam:
    """The flexible body or flexible beam of that name; InputError for a rigid one."""
    body = system.body(name)
    return body if isinstance(body, FlexibleBeam) else flexible_body(system, name)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b.expand_as(a), dim=-1)
