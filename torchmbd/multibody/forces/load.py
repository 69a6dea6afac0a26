"""Forces and torques on a frame that are constant or functions of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.forces.action import Push, Twist
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.forces.laws import OfTime, Scaled, check_law, evaluate_law, three_numbers
from torchmbd.multibody.joints.joint import AttachmentTable

Vector = Sequence[float | Tensor] | Callable[[Tensor], Tensor] | Scaled


class _Load(ForceElement):
    """Three laws of time along the axes of the ground, or of the frame; arguments as in Force."""

    def __init__(self, frame: Frame, vector: Vector, axes: str = "ground", name: str | None = None):
        super().__init__((frame,), name)
        if axes not in ("ground", "frame"):
            raise InputError((self.name, "axes"), axes, "'ground' or 'frame'")
        self.axes = axes
        parts = _parts(self.name, vector)
        self.laws = [
            check_law(self.name, self.law_variables.law_of_time(x, axis)) for axis, x in zip("xyz", parts, strict=True)
        ]

    def _axis(self, attachments: AttachmentTable, axis: str) -> int:
        return attachments.axis(Ground().at() if self.axes == "ground" else self.frames[0], axis)


def _parts(name: str, vector: Any) -> list[Any]:
    """The three components of a vector of numbers, of a function of time, or of Scaled of a function."""
    law: Any = vector.law if isinstance(vector, Scaled) else vector
    if not callable(law):
        return three_numbers((name, "vector"), law)
    result = evaluate_law(name, law, torch.zeros((), dtype=torch.float64))
    if not isinstance(result, Tensor) or result.shape != (3,) or not bool(torch.isfinite(result).all()):
        raise InputError(
            (name, "vector"),
            vector,
            "a torch function of time, [] [s] -> finite [3]",
            state=f"gives {result!r} at t = 0",
        )
    parts = [partial(_component, law, k) for k in range(3)]
    return [Scaled(vector.factor, part) for part in parts] if isinstance(vector, Scaled) else parts


def _component(vector: Callable[..., Any], k: int, t: Tensor) -> Tensor:
    return vector(t)[k]


class Force(_Load):
    """`Force(frame, (fx, fy, fz))`: a force at the point of a frame.

    frame   where it acts
    vector  [N], or a torch function of time, [] [s] -> [3] [N]
    axes    "ground": the force keeps its direction; "frame": it follows the frame
    name    of the element, and of its design variables

    Design variables: Force(frame, (mbd.variable(2.0), 0.0, 0.0), name="push") has "push.x", and
    mbd.forces.Scaled(mbd.variable(1.0), function) has "push.factor".

    >>> block = mbd.RigidBody("block", 2.0, (0.01, 0.01, 0.01))
    >>> system = mbd.System([block], [], [mbd.Force(block.at(), (4.0, 0, 0))], free=["block"])
    >>> motion = mbd.simulate(system, 1.0, steps=10)
    >>> round(mbd.Final(mbd.Position("block", "x"))(motion).item(), 6)  # F t^2 / (2 m) [m]
    1.0
    """

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        for axis, law in zip("xyz", self.laws, strict=True):
            if law != OfTime(0.0):
                yield Applied(Push, (attachments.point(self.frames[0]), self._axis(attachments, axis)), law)


class Torque(_Load):
    """`Torque(frame, (mx, my, mz))`: a torque on the body, or on the node, of a frame.

    vector  [N m], or a torch function of time, [] [s] -> [3] [N m]
    axes    "ground": the torque keeps its direction; "frame": it follows the frame
    name    of the element, and of its design variables

    >>> wheel = mbd.RigidBody("wheel", 2.0, (0.5, 0.5, 0.5))
    >>> system = mbd.System([wheel], [], [mbd.Torque(wheel.at(), (0, 0, 1.0))], free=["wheel"])
    >>> motion = mbd.simulate(system, 1.0, steps=10)
    >>> round(motion.body("wheel").omega[0, -1, 2].item(), 6)  # M t / J [rad/s]
    2.0
    """

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        triad = tuple(attachments.axis(self.frames[0], axis) for axis in "xyz")
        for axis, law in zip("xyz", self.laws, strict=True):
            if law != OfTime(0.0):
                yield Applied(Twist, (self._axis(attachments, axis), *triad), law)
