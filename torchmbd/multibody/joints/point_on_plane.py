"""Point on a plane: a point of body b slides in a plane of body a, free to turn. One equation."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Plane


class PointOnPlane(Joint):
    """`PointOnPlane(a, b, normal="z")`: the point of b stays in the plane of frame a with this `normal`. One equation.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> foot = mbd.RigidBody("foot", 1.0, (0.01, 0.01, 0.01))
    >>> floor = mbd.PointOnPlane(mbd.Ground().at(), foot.at(), normal="z")
    >>> mbd.System([foot], [floor]).describe().freedoms
    5
    """

    def __init__(self, a: Frame, b: Frame, normal: str = "z", name: str | None = None):
        super().__init__(a, b, name)
        axis_index(normal)
        self.normal = normal

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(
            Plane, (attachments.point(self.a), attachments.point(self.b), attachments.axis(self.a, self.normal))
        )
