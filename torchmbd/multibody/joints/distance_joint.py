"""DistanceJoint: a massless link between two points. One equation."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.math.checked_numbers import positive
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Distance


class DistanceJoint(Joint):
    """`DistanceJoint(a, b, length=...)`: the points of both frames keep their distance `length` > 0 [m]. One equation.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> ball = mbd.RigidBody("ball", 1.0, (0.01, 0.01, 0.01), position=(0, -0.7, 0))
    >>> rope = mbd.DistanceJoint(mbd.Ground().at(), ball.at(), length=0.7)
    >>> mbd.System([ball], [rope]).describe().freedoms
    5
    """

    def __init__(self, a: Frame, b: Frame, length: float, name: str | None = None):
        super().__init__(a, b, name)
        self.length = positive((self.name, "length"), length, "m")

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(Distance, (attachments.point(self.a), attachments.point(self.b)), self.length)
