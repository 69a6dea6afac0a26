"""Angle of a body about an axis, seen from another body or from the ground, such as the angle of a hinge.

    theta = atan2(e . (u x R u), u . R u)        R = A_observer' A_body, u a unit vector across e

e       axis, in the axes of the observer
theta   the body's rotation about e if it turns about e alone; else the angle of u, projected along e    [rad]

theta is within half a turn of `center`. Differentiable where the turned u is not parallel to e.
Checked in tests/design/test_angle.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.design.histories import GROUND, Direction, unit_vector
from torchmbd.design.response import History
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import scalar
from torchmbd.multibody.system import System


@dataclass(frozen=True)
class Angle(History):
    """Rotation of a body about an axis of another body, or of the ground [lanes, times] [rad].

    body       the body that turns
    axis       "x", "y", "z" or a direction of three numbers, in the axes of the observer
    seen_from  the observer: a body or "ground"
    center     the angle is given within half a turn of this one [rad]

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> round(mbd.Angle("bob", "z")(motion)[0, -1].item(), 2)
    0.32
    """

    body: str
    axis: Direction
    seen_from: str = GROUND
    center: float = 0.0

    def check(self, system: System) -> None:
        unit_vector(self.axis)
        system.body(self.body)
        if self.seen_from != GROUND:
            system.body(self.seen_from)
        if self.seen_from == self.body:
            raise InputError(f"angle of {self.body!r} seen from itself is zero; allowed: another body, or 'ground'")
        scalar("center of an angle", self.center, "a finite number [rad]")

    def values(self, motion: Trajectory) -> Tensor:
        e = unit_vector(self.axis)
        u = torch.eye(3, dtype=e.dtype)[int(e.abs().argmin())]
        u = torch.linalg.cross(e, u)
        u = u / u.norm()
        turned = motion.body(self.body).A @ u
        if self.seen_from != GROUND:
            turned = torch.einsum("ltji,ltj->lti", motion.body(self.seen_from).A, turned)
        sine, cosine = turned @ torch.linalg.cross(e, u), turned @ u
        c, s = math.cos(self.center), math.sin(self.center)
        return torch.atan2(c * sine - s * cosine, c * cosine + s * sine) + self.center
