"""Fixed joint: two bodies move as one. Six equations."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.joints.joint import Equation, Joint, Scribe
from torchmbd.multibody.joints.primitive import Coincide, Perpendicular


class Fixed(Joint):
    """`Fixed(a, b)`: points coincide, and the rotation of the given initial positions stays."""

    def equations(self, scribe: Scribe) -> Iterator[Equation]:
        yield Equation(Coincide, (scribe.point(self.a), scribe.point(self.b)))
        for first, second in ("xy", "yz", "zx"):
            yield Equation(Perpendicular, (scribe.axis(self.a, first), scribe.twin(self.a, second, self.b)))
