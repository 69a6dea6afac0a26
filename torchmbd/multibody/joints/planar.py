"""Planar joint: body b slides in a plane of body a and turns about its normal. Three equations."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint, other_axes
from torchmbd.multibody.joints.primitive import Perpendicular, Plane


class Planar(Joint):
    """`Planar(a, b, normal="z")`: the point of b stays in the plane of frame a with this `normal`; b turns about it.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> puck = mbd.RigidBody("puck", 1.0, (0.01, 0.01, 0.01))
    >>> table = mbd.Planar(mbd.Ground().at(), puck.at(), normal="z")
    >>> mbd.System([puck], [table]).describe().freedoms
    3
    """

    def __init__(self, a: Frame, b: Frame, normal: str = "z", name: str | None = None):
        super().__init__(a, b, name)
        self.normal = self.common_axis(normal)

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(
            Plane, (attachments.point(self.a), attachments.point(self.b), attachments.axis(self.a, self.normal))
        )
        upright = attachments.coincident_axis(self.a, self.normal, self.b)
        for axis in other_axes(self.normal):
            yield Equation(Perpendicular, (attachments.axis(self.a, axis), upright))
