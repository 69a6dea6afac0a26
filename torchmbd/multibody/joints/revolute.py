"""Revolute joint: two points coincide and one axis is common. Five equations; the rotation about the axis is free."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint, JointCoordinate, other_axes
from torchmbd.multibody.joints.primitive import Coincide, Perpendicular


class Revolute(Joint):
    """`Revolute(a, b, axis="z")`: hinge at the points of both frames, about `axis` of frame a. Five equations.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))
    >>> hinge = mbd.Revolute(mbd.Ground().at(), arm.at(-0.5, 0, 0), axis="z", name="hinge")
    >>> mbd.System([arm], [hinge]).describe().freedoms
    1
    """

    def __init__(self, a: Frame, b: Frame, axis: str = "z", name: str | None = None):
        super().__init__(a, b, name)
        self.axis = self.common_axis(axis)

    @property
    def angle(self) -> JointCoordinate:
        """The angle of b from a about the axis [rad], for `JointCoupling`."""
        return JointCoordinate(self, turns=True)

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
        hinge = attachments.coincident_axis(self.a, self.axis, self.b)
        for normal in other_axes(self.axis):
            yield Equation(Perpendicular, (attachments.axis(self.a, normal), hinge))
