"""Prismatic joint: body b slides along an axis of body a and does not turn. Five equations."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint, JointCoordinate, other_axes
from torchmbd.multibody.joints.primitive import Perpendicular, Plane


class Prismatic(Joint):
    """`Prismatic(a, b, axis="x")`: the point of b slides along `axis` of frame a; b does not turn. Five equations.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> block = mbd.RigidBody("block", 1.0, (0.01, 0.01, 0.01))
    >>> slide = mbd.Prismatic(mbd.Ground().at(), block.at(), axis="x")
    >>> mbd.System([block], [slide]).describe().freedoms
    1
    """

    def __init__(self, a: Frame, b: Frame, axis: str = "x", name: str | None = None):
        super().__init__(a, b, name)
        self.axis = self.common_axis(axis)

    @property
    def travel(self) -> JointCoordinate:
        """The travel of b from a along the axis [m], for `JointCoupling`."""
        return JointCoordinate(self, turns=False)

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        y, z = other_axes(self.axis)
        points = attachments.point(self.a), attachments.point(self.b)
        slide = attachments.coincident_axis(self.a, self.axis, self.b)
        for normal in (y, z):
            yield Equation(Plane, (*points, attachments.axis(self.a, normal)))
            yield Equation(Perpendicular, (attachments.axis(self.a, normal), slide))
        yield Equation(Perpendicular, (attachments.axis(self.a, y), attachments.coincident_axis(self.a, z, self.b)))
