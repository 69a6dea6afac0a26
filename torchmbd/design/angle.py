"""Angle of a body about an axis, seen from another one or from the ground: how far a hinge is open, how well panels align.

    theta = atan2(e . (u x R u), u . R u)        R = A_observer' A_body, u a unit vector across e

e       axis, in the axes of the observer
theta   the body's rotation about e where it turns about e alone; else that of u, projected along e    [rad]

Told within half a turn to both sides of `center`. Differentiable where u is not turned into e.
Checked in tests/design/test_angle.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.design.histories import GROUND, Direction, direction
from torchmbd.design.response import History
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System


@dataclass(frozen=True)
class Angle(History):
    """Rotation of a body about an axis of another one [lanes, times] [rad].

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
        direction(self.axis)
        system.body(self.body)
        if self.seen_from != GROUND:
            system.body(self.seen_from)
        if self.seen_from == self.body:
            raise InputError(f"angle of {self.body!r} seen from itself is zero; allowed: another body, or 'ground'")
        if isinstance(self.center, bool) or not math.isfinite(self.center):
            raise InputError(f"center of an angle is {self.center!r}; allowed: a finite number [rad]")

    def values(self, motion: Trajectory) -> Tensor:
        """Angle [lanes, times] [rad]."""
        e = direction(self.axis)
        u = torch.eye(3, dtype=e.dtype)[int(e.abs().argmin())]
        u = torch.linalg.cross(e, u)
        u = u / u.norm()
        turned = motion.body(self.body).A @ u
        if self.seen_from != GROUND:
            turned = torch.einsum("ltji,ltj->lti", motion.body(self.seen_from).A, turned)
        sine, cosine = turned @ torch.linalg.cross(e, u), turned @ u
        c, s = math.cos(self.center), math.sin(self.center)
        return torch.atan2(c * sine - s * cosine, c * cosine + s * sine) + self.center
