"""Forces and torques on a frame that do not depend on the motion: constant or functions of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from torchmbd.bodies.frame import Frame
from torchmbd.bodies.rigid import Ground
from torchmbd.errors import InputError
from torchmbd.forces.action import Push, Twist
from torchmbd.forces.force import Applied, ForceElement
from torchmbd.forces.laws import OfTime, checked, numbers
from torchmbd.joints.joint import Scribe

Vector = Sequence[float] | Callable[[Tensor], Tensor]


class _Load(ForceElement):
    """axes: "ground" keeps the direction, "frame" follows the frame."""

    def __init__(self, frame: Frame, vector: Vector, axes: str = "ground", name: str | None = None):
        super().__init__((frame,), name)
        if axes not in ("ground", "frame"):
            raise InputError(f"axes of {self.name!r} is {axes!r}; allowed: 'ground', 'frame'")
        self.axes = axes
        if callable(vector):
            found = vector(torch.zeros((), dtype=torch.float64))
            if not isinstance(found, Tensor) or found.shape[:1] != (3,):
                raise InputError(
                    f"vector of {self.name!r} gives {found!r} at t = 0; allowed: a torch function of time, [] [s] -> [3]"
                )
            self.laws = [OfTime(partial(_component, vector, k)) for k in range(3)]
        else:
            self.laws = [OfTime(x) for x in numbers(f"vector of {self.name!r}", vector, 3)]
        for law in self.laws:
            checked(self.name, law)

    def _axis(self, scribe: Scribe, axis: str) -> int:
        return scribe.axis(Ground().at() if self.axes == "ground" else self.frames[0], axis)


def _component(vector: Callable[[Tensor], Tensor], k: int, t: Tensor) -> Tensor:
    return vector(t)[k]


class Force(_Load):
    """`Force(frame, (fx, fy, fz))` [N] at the point of the frame; or a torch function of time, [] [s] -> [3] [N]."""

    def actions(self, scribe: Scribe) -> Iterator[Applied]:
        for axis, law in zip("xyz", self.laws, strict=True):
            if law.law:
                yield Applied(Push, (scribe.point(self.frames[0]), self._axis(scribe, axis)), law)


class Torque(_Load):
    """`Torque(frame, (mx, my, mz))` [N m] on the body (or node) of the frame; or a torch function of time."""

    def actions(self, scribe: Scribe) -> Iterator[Applied]:
        triad = tuple(scribe.axis(self.frames[0], axis) for axis in "xyz")
        for axis, law in zip("xyz", self.laws, strict=True):
            if law.law:
                yield Applied(Twist, (self._axis(scribe, axis), *triad), law)
