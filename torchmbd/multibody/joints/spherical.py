"""Spherical joint: two points coincide. Three equations; all rotations free."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Coincide


class Spherical(Joint):
    """`Spherical(a, b)`: the points of frames a and b coincide. Three equations.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))
    >>> ball = mbd.Spherical(mbd.Ground().at(), arm.at(-0.5, 0, 0))
    >>> mbd.System([arm], [ball]).describe().freedoms
    3
    """

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
