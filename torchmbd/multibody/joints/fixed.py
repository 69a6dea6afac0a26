"""Fixed joint: two bodies move as one. Six equations."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Coincide, Perpendicular


class Fixed(Joint):
    """`Fixed(a, b)`: points coincide, and the rotation of the given initial positions stays."""

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
        for first, second in ("xy", "yz", "zx"):
            yield Equation(
                Perpendicular, (attachments.axis(self.a, first), attachments.coincident_axis(self.a, second, self.b))
            )
