"""Cylindrical joint: body b slides along and turns about an axis of body a. Four equations."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint, JointCoordinate, other_axes
from torchmbd.multibody.joints.primitive import Perpendicular, Plane


class Cylindrical(Joint):
    """`Cylindrical(a, b, axis="z")`: the point of b slides along `axis` of frame a, and b may turn about it. Four equations.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> piston = mbd.RigidBody("piston", 1.0, (0.01, 0.01, 0.01))
    >>> guide = mbd.Cylindrical(mbd.Ground().at(), piston.at(), axis="z")
    >>> mbd.System([piston], [guide]).describe().freedoms
    2
    """

    def __init__(self, a: Frame, b: Frame, axis: str = "z", name: str | None = None):
        super().__init__(a, b, name)
        self.axis = self.common_axis(axis)

    @property
    def angle(self) -> JointCoordinate:
        """The angle of b from a about the axis [rad], for `JointCoupling`."""
        return JointCoordinate(self, turns=True)

    @property
    def travel(self) -> JointCoordinate:
        """The travel of b from a along the axis [m], for `JointCoupling`."""
        return JointCoordinate(self, turns=False)

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        points = attachments.point(self.a), attachments.point(self.b)
        slide = attachments.coincident_axis(self.a, self.axis, self.b)
        for normal in other_axes(self.axis):
            yield Equation(Plane, (*points, attachments.axis(self.a, normal)))
            yield Equation(Perpendicular, (attachments.axis(self.a, normal), slide))
