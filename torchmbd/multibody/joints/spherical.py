"""Spherical joint: two points coincide. Three equations; all rotations free."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Coincide


class Spherical(Joint):
    """`Spherical(a, b)`: the points of frames a and b coincide."""

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
