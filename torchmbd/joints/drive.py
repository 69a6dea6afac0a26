"""Drive: a prescribed rotation of body b relative to body a about an axis. One equation.

The angle is measured from the given initial positions, so a law starts at zero or the assembly moves there.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from torchmbd.bodies.frame import axis_index
from torchmbd.errors import InputError
from torchmbd.joints.joint import Equation, Joint, Scribe, as_frame, others
from torchmbd.joints.primitive import Angle, Law


class ConstantSpeed:
    """theta(t) = speed * t [rad]."""

    def __init__(self, speed: float):
        self.speed = float(speed)

    def __call__(self, t: Tensor) -> Tensor:
        return self.speed * t

    def slopes(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Angle, speed and acceleration at the times t."""
        return self.speed * t, torch.full_like(t, self.speed), torch.zeros_like(t)


class Drive(Joint):
    """`Drive(a, b, axis="z", speed=...)` or `Drive(a, b, axis="z", angle=law)`.

    speed   constant angular speed [rad/s]
    angle   a torch function of time [s] -> angle [rad], twice differentiable; instead of `speed`

    Add a joint that leaves this rotation free (Revolute, Cylindrical): a drive holds nothing else.
    """

    def __init__(
        self,
        a: Any,
        b: Any,
        axis: str = "z",
        speed: float | None = None,
        angle: Law | None = None,
        name: str | None = None,
    ):
        super().__init__(as_frame(a), as_frame(b), name)
        axis_index(axis)
        if (speed is None) == (angle is None):
            raise InputError(f"{self.name!r} has speed={speed!r} and angle={angle!r}; allowed: exactly one of the two")
        if speed is not None and not torch.isfinite(torch.tensor(float(speed))):
            raise InputError(f"speed of {self.name!r} is {speed!r} rad/s; allowed: a finite number")
        if angle is not None:
            _check_law(self.name, angle)
        self.axis = axis
        self.law: Law = ConstantSpeed(speed) if speed is not None else angle  # type: ignore[assignment]

    def equations(self, scribe: Scribe) -> Iterator[Equation]:
        x, y = others(self.axis)
        axes = scribe.axis(self.a, x), scribe.axis(self.a, y), scribe.twin(self.a, x, self.b)
        yield Equation(Angle, axes, self.law)


def _check_law(name: str, angle: Any) -> None:
    start = angle(torch.zeros((), dtype=torch.float64)) if callable(angle) else angle
    if not isinstance(start, Tensor) or start.shape != () or not bool(torch.isfinite(start)):
        raise InputError(
            f"angle of {name!r} gives {start!r} at t = 0; allowed: a torch function of time, [] [s] -> finite [] [rad]"
        )
