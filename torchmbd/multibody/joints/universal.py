"""Universal (Cardan) joint: two points coincide, and the arms of its cross stay perpendicular. Four equations."""

from __future__ import annotations

from collections.abc import Iterator

from torchmbd.errors import InputError
from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Coincide, Perpendicular


class Universal(Joint):
    """`Universal(a, b, axes="yz")`: two letters, both axes of frame a at the start. Four equations.

    The first arm of the cross stays with body a, the second with body b.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))
    >>> cross = mbd.Universal(mbd.Ground().at(), arm.at(-0.5, 0, 0), axes="yz")
    >>> mbd.System([arm], [cross]).describe().freedoms
    2
    """

    def __init__(self, a: Frame, b: Frame, axes: str = "yz", name: str | None = None):
        super().__init__(a, b, name)
        if not isinstance(axes, str) or len(axes) != 2 or axes[0] == axes[1]:
            raise InputError(
                f"axes of {self.name!r} is {axes!r}; allowed: two different letters of 'xyz', such as 'yz'"
            )
        for axis in axes:
            axis_index(axis)
        self.axes = axes

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        first, second = self.axes
        yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
        yield Equation(
            Perpendicular, (attachments.axis(self.a, first), attachments.coincident_axis(self.a, second, self.b))
        )
