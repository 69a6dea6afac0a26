"""Contact: stops of a joint's coordinate, with clearance, and a point or a sphere of a body above a plane.

A penalty law (contact_law.py) pushes overlapping bodies apart, and never pulls.
Planes have no edges. Contact between surfaces, meshes or edges, and of a body with itself, is not implemented.
Checked in tests/multibody/forces/test_contact.py, tests/contracts/test_actions.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.variable import ParameterVector, number
from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.forces.action import Along, Spin, Turn
from torchmbd.multibody.forces.contact_law import ContactControl, ContactNumbers, PlaneControl, StopControl
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.joints.joint import AttachmentTable, other_axes

MOST_TURN = 2.0 * math.pi - 0.2  # [rad] largest difference of the limits of an angle, which is known up to a turn


class _Contact(ForceElement):
    """Contact between two frames, whose law is a controller."""

    control: ContactControl

    @property
    def variables(self) -> ParameterVector | None:
        return self.control.variables

    @property
    def between(self) -> str:
        """The names of both bodies, for messages."""
        return " and ".join(repr(frame.body.name) for frame in self.frames)


class _Stop(_Contact):
    """Stops of a coordinate. lower, upper: its limits, None: no limit; others as in the docstring of each kind."""

    def __init__(
        self,
        a: Frame,
        b: Frame,
        axis: str,
        lower: float | Tensor | None,
        upper: float | Tensor | None,
        stiffness: float | Tensor,
        damping: float | Tensor,
        exponent: float | Tensor,
        name: str | None,
    ):
        super().__init__((a, b), name)
        axis_index(axis)
        self.axis = axis
        limits = {side: x for side, x in (("lower", lower), ("upper", upper)) if x is not None}
        if not limits:
            raise InputError(
                (self.name,),
                allowed="must have at least one of them",
                noun=repr(self.name),
                state="has neither lower nor upper",
            )
        numbers = limits | {"stiffness": stiffness, "damping": damping, "exponent": exponent}
        module = ContactNumbers(self.name, numbers)
        values = [float(number(getattr(module, side))) for side in limits]
        if values != sorted(values):
            raise InputError((self.name, "lower"), values[0], f"below upper = {values[1]:g}", shown=f"{values[0]:g}")
        self.width, self.middle = values[-1] - values[0], 0.5 * (values[0] + values[-1])
        self.control = StopControl(self.name, module, list(limits), self.between)

    def _port(self, center: float = 0.0) -> Port:
        return Port(self.control, ((0, False), (1, True)), 0, center=center)


class AxialStop(_Stop):
    """Stops of a sliding joint: s = (g_b - g_a) . axis stays between two limits, or above or below one.

    a, b, axis     the frames, and the axis of frame a along which they slide, as in AxialSpringDamper
    arguments      lower, upper: limits [m], at least one of them; stiffness k [N/m^n], damping c [s/m] (0) and exponent n (1)
                   of the penalty force k d^n (1 + c d'), d the penetration, which never pulls; and the name of the element.
                   All these numbers may be design variables: "stop.upper"

    >>> block = mbd.RigidBody("block", 2.0, (0.01, 0.01, 0.01), velocity=(1.0, 0, 0))
    >>> slide = mbd.Prismatic(mbd.Ground().at(), block.at(), axis="x")
    >>> stop = mbd.AxialStop(mbd.Ground().at(), block.at(), "x", lower=-0.1, upper=0.1, stiffness=1e5)
    >>> motion = mbd.simulate(mbd.System([block], [slide], [stop]), 0.2, steps=200)
    >>> round(mbd.Final(mbd.Velocity("block", "x"))(motion).item(), 2)  # it came back from the stop at 0.1 m
    -1.0
    """

    def __init__(
        self,
        a: Frame,
        b: Frame,
        axis: str = "x",
        lower: float | Tensor | None = None,
        upper: float | Tensor | None = None,
        stiffness: float | Tensor = 1e4,
        damping: float | Tensor = 0.0,
        exponent: float | Tensor = 1.0,
        name: str | None = None,
    ):
        super().__init__(a, b, axis, lower, upper, stiffness, damping, exponent, name)

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        vectors = attachments.point(a), attachments.point(b), attachments.axis(a, self.axis)
        yield Applied(Along, vectors, self._port())


class RotationalStop(_Stop):
    """Stops of a hinge: the angle about an axis of frame a stays between two limits, or above or below one.

    a, b, axis     the frames, the axis of frame a; the angle is that of RotationalSpringDamper, within half a turn of the
                   middle of the limits, or of the only one
    arguments      lower, upper: limits [rad], at least one of them, less than a turn apart; stiffness k [N m/rad^n],
                   damping c [s/rad] (0) and exponent n (1) of the penalty torque k d^n (1 + c d'), d the penetration [rad],
                   which never pulls; and the name of the element. All these numbers may be design variables

    >>> arm = mbd.RigidBody("arm", 1.0, (0.02, 0.02, 0.02), angular_velocity=(0, 0, 2.0))
    >>> hinge = mbd.Revolute(mbd.Ground().at(), arm.at(), axis="z")
    >>> stop = mbd.RotationalStop(mbd.Ground().at(), arm.at(), "z", lower=-0.3, upper=0.3, stiffness=500.0)
    >>> motion = mbd.simulate(mbd.System([arm], [hinge], [stop]), 0.25, steps=200)
    >>> round(motion.body("arm").omega[0, -1, 2].item(), 2)  # [rad/s]
    -2.0
    """

    def __init__(
        self,
        a: Frame,
        b: Frame,
        axis: str = "z",
        lower: float | Tensor | None = None,
        upper: float | Tensor | None = None,
        stiffness: float | Tensor = 1e4,
        damping: float | Tensor = 0.0,
        exponent: float | Tensor = 1.0,
        name: str | None = None,
    ):
        super().__init__(a, b, axis, lower, upper, stiffness, damping, exponent, name)
        if self.width > MOST_TURN:
            raise InputError(
                (self.name, "limits"),
                self.width,
                f"at most {MOST_TURN:.4g} rad, because an angle is known only up to a whole turn",
                state=f"are {self.width:.4g} rad apart",
            )

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        vectors = attachments.turning_axes(self.name, a, b, self.axis)
        yield Applied(Turn, vectors, self._port(self.middle))


class PlaneContact(_Contact):
    """Contact of a point of a body, or a sphere about it, with a plane of another body or the ground, with friction.

    plane      frame whose origin is on the plane
    point      frame of the body whose point touches, or is the center of the sphere
    normal     axis of the frame `plane`, which points out of the material
    radius     of the sphere [m]; 0: a point
    stiffness  k [N/m^n] of the penalty force N = k d^n (1 + c d'), d the penetration
    damping    c [s/m]; the force never pulls
    exponent   n, 1 or more: 1.5 for a sphere by Hertz
    friction   coefficient mu of the force mu N tanh(|u| / speed) against sliding; 0: none
    speed      u0 [m/s], below which friction decreases to zero: bodies creep instead of sticking
    name       of the element, and of its design variables. All these numbers may be design variables, such as
               "floor.stiffness"

    Both bodies get the force at the point where they touch, a sphere also its moment: it rolls. The plane has no edge, and
    no other part of the body touches it.

    >>> ball = mbd.RigidBody("ball", 1.0, (0.01, 0.01, 0.01), position=(0, 0, 0.1))
    >>> floor = mbd.PlaneContact(mbd.Ground().at(), ball.at(), stiffness=1e5)
    >>> system = mbd.System([ball], forces=[floor], gravity=(0, 0, -9.81), free=["ball"])
    >>> motion = mbd.simulate(system, 0.28, steps=400)  # down, and nearly up again
    >>> round(mbd.Final(mbd.Position("ball", "z"))(motion).item(), 2)  # [m]
    0.1
    """

    def __init__(
        self,
        plane: Frame,
        point: Frame,
        normal: str = "z",
        radius: float | Tensor = 0.0,
        stiffness: float | Tensor = 1e5,
        damping: float | Tensor = 0.0,
        exponent: float | Tensor = 1.0,
        friction: float | Tensor = 0.0,
        speed: float | Tensor = 0.01,
        name: str | None = None,
    ):
        super().__init__((plane, point), name)
        axis_index(normal)
        self.normal = normal
        numbers = {"radius": radius, "stiffness": stiffness, "damping": damping, "exponent": exponent}
        self.has_friction = not _zero(friction)
        self.rolls = self.has_friction and not _zero(radius)
        numbers |= {"friction": friction, "speed": speed} if self.has_friction else {}
        self.control = PlaneControl(
            self.name, ContactNumbers(self.name, numbers), self.has_friction, self.rolls, self.between
        )

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        points = attachments.point(a), attachments.point(b)
        yield Applied(
            Along, (*points, attachments.axis(a, self.normal)), Port(self.control, ((0, False), (1, True)), 0)
        )
        if not self.has_friction:
            return
        axes = [attachments.axis(a, axis) for axis in other_axes(self.normal)]
        for k, axis in enumerate(axes):
            yield Applied(Along, (*points, axis), Port(self.control, ((2 + k, True),), 1 + k))
        if self.rolls:
            triads = [attachments.axis(frame, axis) for frame in (a, b) for axis in "xyz"]
            for k, axis in enumerate(axes):
                yield Applied(Spin, (axis, *triads), Port(self.control, ((4 + k, True),), 3 + k))


def _zero(x: Any) -> bool:
    """True if x is the number zero, and no design variable."""
    return not isinstance(x, Tensor) and x == 0.0
