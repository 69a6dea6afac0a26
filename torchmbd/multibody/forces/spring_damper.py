"""Spring-damper-actuators between two frames: along the line of two points, along an axis, or about an axis.

`law` is any torch function (s, s', t) -> generalized force in the direction of growing s; eq. (39) of the paper is one.
Stiffness, damping and rest may be design variables, stiffness=mbd.variable(2e3), as may the factor of
law=mbd.forces.Scaled(mbd.variable(1.0), law); they are parameters of the system by the element's name: "spring.stiffness".
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.forces.action import Along, Law, Length, Turn
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.forces.laws import Spring, checked
from torchmbd.multibody.joints.joint import AttachmentTable, others


class _Between(ForceElement):
    """a, b: the frames; name: of the element, and of its design variables; others as told by each kind."""

    def __init__(
        self,
        a: Frame,
        b: Frame,
        stiffness: float | Tensor = 0.0,
        damping: float | Tensor = 0.0,
        rest: float | Tensor = 0.0,
        law: Law | None = None,
        name: str | None = None,
    ):
        super().__init__((a, b), name)
        numbers: Any = (stiffness, damping, rest)  # of which some may vary
        spring = self.varying.law(Spring(*numbers))
        if law is not None and spring != Spring():
            raise InputError(f"{self.name!r} has a law and stiffness, damping or rest; allowed: the one or the others")
        if law is None and spring == Spring(rest=getattr(spring, "rest", 0.0)):
            raise InputError(f"{self.name!r} has neither law nor stiffness nor damping; allowed: at least one of them")
        self.law = checked(self.name, spring if law is None else self.varying.law(law))


class SpringDamper(_Between):
    """`SpringDamper(a, b, stiffness=k, damping=c, rest=l0)` or `SpringDamper(a, b, law=f)`: along the line a-b.

    stiffness [N/m], damping [N s/m], rest: unstretched length [m]
    law        f(l, l', t) [N], positive when it pushes the points apart
    """

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        yield Applied(Length, (attachments.point(a), attachments.point(b)), self.law)


class AxialSpringDamper(_Between):
    """`AxialSpringDamper(a, b, axis="x", ...)`: along an axis of frame a, s = (g_b - g_a) . axis, of a sliding joint.

    stiffness [N/m], damping [N s/m], rest [m]; law f(s, s', t) [N] on b along the axis
    given  these, and the name
    """

    def __init__(self, a: Frame, b: Frame, axis: str = "x", **given):
        super().__init__(a, b, **given)
        axis_index(axis)
        self.axis = axis

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        yield Applied(Along, (attachments.point(a), attachments.point(b), attachments.axis(a, self.axis)), self.law)


class RotationalSpringDamper(_Between):
    """`RotationalSpringDamper(a, b, axis="z", ...)`: about an axis of frame a, of a hinge.

    The angle is that of the axis after `axis` (z -> x) of frame b from the same axis of frame a; within half a turn of the
    rest angle, or of `law.center`.

    stiffness [N m/rad], damping [N m s/rad], rest [rad]; law f(theta, theta', t) [N m] on b about the axis
    given  these, and the name
    """

    def __init__(self, a: Frame, b: Frame, axis: str = "z", **given):
        super().__init__(a, b, **given)
        axis_index(axis)
        self.axis = axis

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        x, y = others(self.axis)
        yield Applied(Turn, (attachments.axis(a, x), attachments.axis(a, y), attachments.axis(b, x)), self.law)
