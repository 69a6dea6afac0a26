"""Angle of a body about an axis, seen from another body or from the ground, such as the angle of a hinge.

    theta = atan2(e . (u x R u), u . R u)        R = A_observer' A_body, u a unit vector across e

e       axis, in the axes of the observer
theta   the body's rotation about e if it turns about e alone; else the angle of u, projected along e    [rad]

At the given positions of the bodies R u is at least 45 degrees from e: a plate that stands upright has its y axis along z, and
its angle about z is that of its x axis.

theta is within half a turn of `center` at the start and continuous from there on: of two times the turns between follow from
the mean of the rates there, so that a body may turn far in a step. The event of a phase sees the same angle (turns.py).
Differentiable where the turned u is not parallel to e.
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
from torchmbd.results.turns import turns_between

_ALONG = math.sqrt(0.5) + 1e-12  # cosine of 45 degrees, and rounding: a vector at 45 degrees stays the one that it is


@dataclass(frozen=True)
class Angle(History):
    """Rotation of a body about an axis of another body, or of the ground [lanes, times] [rad]; continuous along a motion.

    body       the body that turns
    axis       "x", "y", "z" or a direction of three numbers, in the axes of the observer
    seen_from  the observer: a body or "ground"
    center     the angle at the start is within half a turn of `center` [rad]
    wrapped    True: the angle is within half a turn of `center` at all times. It then jumps by a turn, so measures refuse it

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> round(mbd.Angle("bob", "z")(motion)[0, -1].item(), 2)
    0.32
    """

    body: str
    axis: Direction
    seen_from: str = GROUND
    center: float = 0.0
    wrapped: bool = False

    @property
    def smooth(self) -> bool:
        return not self.wrapped

    @property
    def natural_zero(self) -> bool:
        return False

    def check(self, system: System) -> None:
        unit_vector(self.axis)
        system.body(self.body)
        if self.seen_from != GROUND:
            system.body(self.seen_from)
        if self.seen_from == self.body:
            raise InputError(
                "seen_from",
                self.body,
                "seen from another body, or 'ground'",
                state="is zero",
                noun=f"angle of {self.body!r} seen from itself",
            )
        scalar("center", self.center, "a finite number [rad]")
        if not isinstance(self.wrapped, bool):
            raise InputError("wrapped", self.wrapped, "True or False")

    def values(self, motion: Trajectory) -> Tensor:
        angle, rate = self.wrapped_jet(motion)
        if self.wrapped:
            return angle
        before = None if motion.turns is None else motion.turns.before(self)
        return angle + 2.0 * math.pi * turns_between(motion, angle.detach(), rate.detach(), before)

    def wrapped_jet(self, motion: Trajectory) -> tuple[Tensor, Tensor]:
        """The angle within half a turn of `center`, and its rate [lanes, times]."""
        e = unit_vector(self.axis)
        u = self._arm(motion.system, e)
        across = torch.linalg.cross(e, u)
        body = motion.body(self.body)
        A, omega = body.A, body.omega
        turned, rate = A @ u, (A @ torch.linalg.cross(omega, u.expand_as(omega))[..., None])[..., 0]
        if self.seen_from != GROUND:
            observer = motion.body(self.seen_from)
            A = observer.A
            turned, rate = (torch.einsum("ltji,ltj->lti", A, x) for x in (turned, rate))
            rate = rate - torch.linalg.cross(observer.omega, turned)
        sine, cosine = turned @ across, turned @ u
        c, s = math.cos(self.center), math.sin(self.center)
        angle = torch.atan2(c * sine - s * cosine, c * cosine + s * sine) + self.center
        square = (sine * sine + cosine * cosine).detach()
        return angle, (cosine * (rate @ across) - sine * (rate @ u)) / torch.where(square > 0.0, square, 1.0)

    def _arm(self, system: System, e: Tensor) -> Tensor:
        """The unit vector u across e: of two that are perpendicular, at most one is less than 45 degrees from e when turned."""
        u = torch.linalg.cross(e, torch.eye(3, dtype=e.dtype)[int(e.abs().argmin())])
        u = u / u.norm()
        turned = system.body(self.body).axes.detach() @ u
        if self.seen_from != GROUND:
            turned = system.body(self.seen_from).axes.detach().T @ turned
        return torch.linalg.cross(e, u) if abs(float(e @ turned)) > _ALONG else u
