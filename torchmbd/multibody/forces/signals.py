"""Inputs and outputs of a `Controller`.

    inputs     JointAngle, JointRate, JointTravel, JointSpeed, PointPosition, PointVelocity, Time
    outputs    JointTorque, JointForce, TorqueOn, ForceOn

Angles and travels of joints are measured from the given initial positions, angles within half a turn of their `center`.
Positions and velocities are in ground axes. Each input or output is one or several actions of the kinds of action.py.

>>> [hinge] = mbd.examples.pendulum().joints
>>> inputs, outputs = [mbd.signals.JointAngle(hinge), mbd.signals.Time()], [mbd.signals.JointTorque(hinge)]
>>> mbd.Controller(torch.nn.Linear(2, 1).double(), inputs, outputs, name="servo").name
'servo'

Checked in tests/multibody/forces/test_controller.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torchmbd.errors import InputError
from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.bodies.rigid import Ground, same_body
from torchmbd.multibody.forces.action import Along, Push, Turn, Twist
from torchmbd.multibody.joints.cylindrical import Cylindrical
from torchmbd.multibody.joints.joint import AttachmentTable, JointCoordinate
from torchmbd.multibody.joints.laws import finite
from torchmbd.multibody.joints.prismatic import Prismatic
from torchmbd.multibody.joints.revolute import Revolute

__all__ = [
    "ForceOn", "JointAngle", "JointForce", "JointRate", "JointSpeed", "JointTorque", "JointTravel", "PointPosition",
    "PointVelocity", "Time",
]  # fmt: skip


def __dir__() -> list[str]:
    return [*__all__]


class Coordinate(NamedTuple):
    """A number of an input: s of an action, or its rate s'."""

    kind: type
    vectors: tuple[int, ...]
    rate: bool
    center: float = 0.0


class Effort(NamedTuple):
    """An action of an actuator; its force or torque is the output of the controller times a sign."""

    kind: type
    vectors: tuple[int, ...]
    sign: float = 1.0


class Signal:
    """An input of a controller: `size` numbers of the motion."""

    size = 1
    frames: tuple[Frame, ...] = ()

    def coordinates(self, attachments: AttachmentTable) -> Sequence[Coordinate | None]:
        """The coordinate of each of its numbers; None is the time."""
        raise NotImplementedError(type(self).__name__)


class Time(Signal):
    """The time [s]."""

    def coordinates(self, attachments: AttachmentTable) -> Sequence[Coordinate | None]:
        return (None,)


class _OfJoint(Signal):
    _joints: tuple[type, ...]
    _rate = False

    def __init__(self, joint: Any):
        self.joint = _checked_joint(self, joint, self._joints)
        self.frames = (joint.a, joint.b)


class JointAngle(_OfJoint):
    """Rotation of b from a about the axis of a revolute or cylindrical joint [rad]; `center`: see the module header."""

    _joints = (Revolute, Cylindrical)

    def __init__(self, joint: Any, center: float = 0.0):
        super().__init__(joint)
        self.center = finite("center", center)

    def coordinates(self, attachments: AttachmentTable) -> Sequence[Coordinate | None]:
        vectors = JointCoordinate(self.joint, turns=True).vectors(attachments)
        return (Coordinate(Turn, vectors, self._rate, self.center),)


class JointRate(JointAngle):
    """Angular velocity of b from a about the axis of a revolute or cylindrical joint [rad/s]."""

    _rate = True

    def __init__(self, joint: Any):
        super().__init__(joint)


class JointTravel(_OfJoint):
    """Travel of b from a along the axis of a prismatic or cylindrical joint [m]."""

    _joints = (Prismatic, Cylindrical)

    def coordinates(self, attachments: AttachmentTable) -> Sequence[Coordinate | None]:
        return (Coordinate(Along, JointCoordinate(self.joint, turns=False).vectors(attachments), self._rate),)


class JointSpeed(JointTravel):
    """Velocity of b from a along the axis of a prismatic or cylindrical joint [m/s]."""

    _rate = True


class PointPosition(Signal):
    """Position of the point of a frame in ground axes, three numbers [m]."""

    size = 3
    _rate = False

    def __init__(self, frame: Frame):
        self.frames = (_frame(self, frame),)

    def coordinates(self, attachments: AttachmentTable) -> Sequence[Coordinate | None]:
        ground, (frame,) = Ground().at(), self.frames
        points = attachments.point(ground), attachments.point(frame)
        return [Coordinate(Along, (*points, attachments.axis(ground, axis)), self._rate) for axis in "xyz"]


class PointVelocity(PointPosition):
    """Velocity of the point of a frame in ground axes, three numbers [m/s]."""

    _rate = True


class Actuator:
    """An output of a controller: one generalized force."""

    frames: tuple[Frame, ...] = ()

    def efforts(self, attachments: AttachmentTable) -> Sequence[Effort]:
        """The actions that it sets."""
        raise NotImplementedError(type(self).__name__)


class TorqueOn(Actuator):
    """`TorqueOn(a, b, axis="z")`: a torque on b about an axis of frame a, and the opposite one on a [N m]."""

    def __init__(self, a: Frame, b: Frame, axis: str = "z"):
        self.frames, self.axis = (_frame(self, a), _frame(self, b)), axis
        axis_index(axis)
        if same_body(a.body, b.body):
            raise InputError(
                "b",
                b,
                "must act between two different bodies",
                state=f"acts between {a!r} and {b!r}",
                noun=f"{type(self).__name__}",
            )

    def efforts(self, attachments: AttachmentTable) -> Sequence[Effort]:
        u = attachments.axis(self.frames[0], self.axis)
        efforts = []
        for frame, sign in zip(self.frames, (-1.0, 1.0), strict=True):
            if not isinstance(frame.body, Ground):
                efforts.append(Effort(Twist, (u, *(attachments.axis(frame, axis) for axis in "xyz")), sign))
        return efforts


class JointTorque(TorqueOn):
    """The torque of a motor in a revolute or cylindrical joint: on b about its axis, and the opposite one on a [N m]."""

    def __init__(self, joint: Any):
        _checked_joint(self, joint, (Revolute, Cylindrical))
        super().__init__(joint.a, joint.b, joint.axis)


class JointForce(Actuator):
    """The force of a motor in a prismatic or cylindrical joint: on b along its axis, and the opposite one on a [N]."""

    def __init__(self, joint: Any):
        self.joint = _checked_joint(self, joint, (Prismatic, Cylindrical))
        self.frames = (joint.a, joint.b)

    def efforts(self, attachments: AttachmentTable) -> Sequence[Effort]:
        return (Effort(Along, JointCoordinate(self.joint, turns=False).vectors(attachments)),)


class ForceOn(Actuator):
    """`ForceOn(frame, axis="x", axes="ground")`: a force at the point of a frame [N].

    axes    "ground": along an axis of the ground; "frame": along one of the frame
    """

    def __init__(self, frame: Frame, axis: str = "x", axes: str = "ground"):
        self.frames, self.axis, self.axes = (_frame(self, frame),), axis, axes
        axis_index(axis)
        if axes not in ("ground", "frame"):
            raise InputError("axes", axes, "'ground' or 'frame'", noun="axes of ForceOn")
        if isinstance(frame.body, Ground):
            raise InputError(
                "frame", frame, "must act on a frame on a body", state=f"acts on {frame!r}", noun="ForceOn"
            )

    def efforts(self, attachments: AttachmentTable) -> Sequence[Effort]:
        (frame,) = self.frames
        owner = Ground().at() if self.axes == "ground" else frame
        return (Effort(Push, (attachments.point(frame), attachments.axis(owner, self.axis))),)


def _checked_joint(owner: Any, joint: Any, kinds: tuple[type, ...]) -> Any:
    if not isinstance(joint, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise InputError(
            "joint",
            joint,
            f"must get a joint of the system of the kind {names}",
            state=f"got {joint!r}",
            noun=f"{type(owner).__name__}",
        )
    return joint


def _frame(owner: Any, frame: Any) -> Frame:
    if not isinstance(frame, Frame):
        raise InputError(
            "frame",
            frame,
            "must get a frame, such as body.at(...)",
            state=f"got {frame!r}",
            noun=f"{type(owner).__name__}",
        )
    return frame
