"""Universal (Cardan) joint: two points coincide, and the arms of its cross stay perpendicular. Four equations."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from torchmbd.errors import InputError, warn
from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Coincide, Perpendicular

_SKEW = 1e-3  # [rad] of axes that are typed with three digits


class Universal(Joint):
    """`Universal(a, b, axes="yz")`: two letters, both axes of frame a at the start. Four equations.

    The first arm of the cross is fixed to body a, and the second arm to body b. If the shafts are at an angle at the start,
    choose the letters, or the axes of frame a, so that the second arm is perpendicular to both shafts. Otherwise the cross is
    skewed, and the motion differs from a Hooke's joint. If the second frame has its own axes, they give the direction of its
    shaft, and a warning gives the angle by which the cross is skewed.

    name    of the joint in reactions and messages; None: made of the kind and the bodies

    >>> arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))
    >>> cross = mbd.Universal(mbd.Ground().at(), arm.at(-0.5, 0, 0), axes="yz")
    >>> mbd.System([arm], [cross]).describe().freedoms
    2
    """

    def __init__(self, a: Frame, b: Frame, axes: str = "yz", name: str | None = None):
        super().__init__(a, b, name)
        if not isinstance(axes, str) or len(axes) != 2 or axes[0] == axes[1]:
            raise InputError((self.name, "axes"), axes, "two different letters of 'xyz', such as 'yz'")
        for axis in axes:
            axis_index(axis)
        self.axes = axes
        skew = self._skew()
        if skew > _SKEW:
            warn(
                f"the cross of {self.name!r} is skewed at the start: its second arm, {axes[1]!r} of {a!r}, is {skew:.2g} rad "
                f"from {axes[1]!r} of {b!r}. Try: frames with the same second arm, perpendicular to both shafts"
            )

    def _skew(self) -> float:
        """Angle between the second arm and that axis of a second frame with axes of its own, whatever their senses [rad]."""
        if torch.equal(self.b.axes, torch.eye(3, dtype=torch.float64)):
            return 0.0
        axis_a, axis_b = (frame.body.axes.detach() @ frame.axis(self.axes[1]) for frame in (self.a, self.b))
        return math.asin(min(float(torch.linalg.cross(axis_a, axis_b).norm()), 1.0))

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        first, second = self.axes
        yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
        yield Equation(
            Perpendicular, (attachments.axis(self.a, first), attachments.coincident_axis(self.a, second, self.b))
        )
