"""Fixed joint: two bodies move as one. Six equations."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Coincide, Perpendicular


class Fixed(Joint):
    """`Fixed(a, b)`: the points coincide, and the relative rotation keeps its initial value. Six equations.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> tool = mbd.RigidBody("tool", 1.0, (0.01, 0.01, 0.01))
    >>> grip = mbd.Fixed(mbd.Ground().at(), tool.at())
    >>> mbd.System([tool], [grip]).describe().freedoms
    0
    """

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
        for first, second in ("xy", "yz", "zx"):
            yield Equation(
                Perpendicular, (attachments.axis(self.a, first), attachments.coincident_axis(self.a, second, self.b))
            )
