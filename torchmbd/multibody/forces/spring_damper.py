"""Spring-damper-actuators between two frames: along the line of two points, along an axis, or about an axis.

`law` is any torch function (s, s', t) -> generalized force in the direction of growing s; eq. (39) of the paper is one.
Stiffness, damping and rest may be design variables, stiffness=mbd.variable(2e3), as may the factor of
law=mbd.forces.Scaled(mbd.variable(1.0), law); they are parameters of the system by the element's name: "spring.stiffness".
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.plausible_units import warn_negative
from torchmbd.math.variable import number
from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.forces.action import Along, Law, Length, Turn
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.forces.laws import Spring, check_law
from torchmbd.multibody.joints.joint import AttachmentTable

_NEGATIVE = "pushes away from its rest position", "adds energy to the motion"  # negative stiffness, negative damping


class _Between(ForceElement):
    """a, b: the frames; name: of the element, and of its design variables; others as described by each kind.

    units   of stiffness and damping
    """

    units: ClassVar[tuple[str, str]] = ("N/m", "N s/m")

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
        numbers: dict[str, Any] = {"stiffness": stiffness, "damping": damping, "rest": rest}  # of which some may vary
        spring = self.law_variables.law(Spring(**numbers))
        if law is not None and spring != Spring():
            raise InputError(
                (self.name,),
                allowed="must have a law alone, or stiffness, damping and rest",
                noun=repr(self.name),
                state="has a law, and also stiffness, damping or rest",
            )
        if law is None and spring == Spring(rest=getattr(spring, "rest", 0.0)):
            raise InputError(
                (self.name,),
                allowed="must have at least one of them",
                noun=repr(self.name),
                state="has neither law nor stiffness nor damping",
            )
        for label, unit, consequence in zip(("stiffness", "damping"), self.units, _NEGATIVE, strict=True):
            warn_negative(f"{label} of {self.name!r}", float(number(numbers[label])), unit, consequence)
        self.law = check_law(self.name, spring if law is None else self.law_variables.law(law))


class SpringDamper(_Between):
    """Spring and damper along the line from a to b, linear, or with a law of your own.

    stiffness [N/m], damping [N s/m], rest: unstretched length [m]
    law        f(l, l', t) [N], positive when it pushes the points apart; instead of the three numbers
    name       of the element, and of its design variables

    >>> ball = mbd.RigidBody("ball", 1.0, (0.01, 0.01, 0.01), position=(0, 0, -0.5))
    >>> spring = mbd.SpringDamper(mbd.Ground().at(), ball.at(), stiffness=200.0, damping=1.0, rest=0.5, name="spring")
    >>> system = mbd.System([ball], [], [spring], gravity=(0, 0, -9.81), free=["ball"])
    >>> motion = mbd.simulate(system, 0.1, steps=10)
    >>> round(mbd.Final(mbd.Position("ball", "z"))(motion).item(), 3)  # [m]
    -0.54
    """

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        yield Applied(Length, (attachments.point(a), attachments.point(b)), self.law)


class AxialSpringDamper(_Between):
    """Spring and damper along an axis of frame a: s = (g_b - g_a) . axis, for a sliding joint.

    arguments  stiffness [N/m], damping [N s/m], rest [m], or a law f(s, s', t) [N] on b along the axis; and the name

    >>> ground, block = mbd.Ground(), mbd.RigidBody("block", 2.0, (0.01, 0.01, 0.01))
    >>> slide = mbd.Prismatic(ground.at(), block.at(), axis="x")
    >>> spring = mbd.AxialSpringDamper(ground.at(), block.at(), axis="x", stiffness=200.0)
    >>> rest = mbd.equilibrium(mbd.System([block], [slide], [spring]))
    >>> round(rest.vibrations[0].frequencies.item(), 4)  # sqrt(200 / 2) / (2 pi) [Hz]
    1.5915
    """

    def __init__(
        self,
        a: Frame,
        b: Frame,
        axis: str = "x",
        stiffness: float | Tensor = 0.0,
        damping: float | Tensor = 0.0,
        rest: float | Tensor = 0.0,
        law: Law | None = None,
        name: str | None = None,
    ):
        super().__init__(a, b, stiffness, damping, rest, law, name)
        axis_index(axis)
        self.axis = axis

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        yield Applied(Along, (attachments.point(a), attachments.point(b), attachments.axis(a, self.axis)), self.law)


class RotationalSpringDamper(_Between):
    """Spring and damper about an axis of frame a, for a hinge.

    The angle is measured about `axis`, from the next axis of frame a to the same axis of frame b (for axis "z": from x of a
    to x of b). It lies within half a turn of the rest angle, or of `law.center`. A frame b whose x axis is along `axis` shows
    no angle and is refused: give the frame other axes, `body.at(point, axes=...)`.

    arguments  stiffness [N m/rad], damping [N m s/rad], rest [rad], or a law f(theta, theta', t) [N m] on b about the axis;
               and the name

    >>> ground, arm = mbd.Ground(), mbd.RigidBody("arm", 1.0, (0.02, 0.02, 0.02))
    >>> hinge = mbd.Revolute(ground.at(), arm.at(), axis="z")
    >>> spring = mbd.RotationalSpringDamper(ground.at(), arm.at(), axis="z", stiffness=2.0)
    >>> rest = mbd.equilibrium(mbd.System([arm], [hinge], [spring]))
    >>> round(rest.vibrations[0].frequencies.item(), 4)  # sqrt(2 / 0.02) / (2 pi) [Hz]
    1.5915
    """

    units: ClassVar[tuple[str, str]] = ("N m/rad", "N m s/rad")

    def __init__(
        self,
        a: Frame,
        b: Frame,
        axis: str = "z",
        stiffness: float | Tensor = 0.0,
        damping: float | Tensor = 0.0,
        rest: float | Tensor = 0.0,
        law: Law | None = None,
        name: str | None = None,
    ):
        super().__init__(a, b, stiffness, damping, rest, law, name)
        axis_index(axis)
        self.axis = axis

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        a, b = self.frames
        yield Applied(Turn, attachments.turning_axes(self.name, a, b, self.axis), self.law)
