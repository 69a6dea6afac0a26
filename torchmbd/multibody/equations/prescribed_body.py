"""Prescribed bodies: their motion is known, because joints to the ground and a drive leave them no degree of freedom
(condensation.py).

    angle(t) = law(t) - law(0)        A(t) = turn(angle) A,   r(t) = r + (turn(angle) - 1) (r - center)

Checked in tests/multibody/saddle/test_condensation.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.forward_mode import jvp
from torchmbd.math.pair import Pair, value
from torchmbd.math.rotation import euler_parameters, quaternion_product
from torchmbd.multibody.joints.primitive import slopes_at, values_at


@dataclass(frozen=True)
class PrescribedBody:
    """A body that turns about an axis fixed in the ground, by the angle of a law minus its value at t = 0.

    A, r   pose at the start [3, 3], [3]
    spin   skew matrix of the axis, signed [3, 3]; center a point of the axis [3]
    law    angle over time, or None for a body at rest
    """

    name: str
    A: Tensor
    r: Tensor
    spin: Tensor
    center: Tensor
    law: Any = None

    @cached_property
    def _p(self) -> Tensor:
        """Euler parameters at the start [4]."""
        return euler_parameters(self.A)

    @cached_property
    def _axis(self) -> Tensor:
        """Axis [3] in the ground."""
        return torch.stack([self.spin[2, 1], self.spin[0, 2], self.spin[1, 0]])

    def poses(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations [3, 3, n] and origins [3, n] at times [n]."""
        if self.law is None:
            return self.A[..., None].expand(3, 3, len(times)), self.r[:, None].expand(3, len(times))
        angle = values_at(self.law, times) - self.law(torch.zeros_like(times[0]))
        x, sine, rest = (
            torch.cat([self.A, (self.r - self.center)[:, None]], 1),
            torch.sin(angle),
            1.0 - torch.cos(angle),
        )
        turned = self.spin @ x
        moved = sine * turned[..., None] + rest * (self.spin @ turned)[..., None]
        return self.A[..., None] + moved[:, :3], self.r[:, None] + moved[:, 3]

    def turned(self, angle: Tensor) -> tuple[Tensor, Tensor]:
        """Euler parameters [n, 4] and origins [n, 3] at angles [n] from the start."""
        turn = torch.cat([torch.cos(0.5 * angle)[None], torch.sin(0.5 * angle) * self._axis[:, None]])
        x = self.spin @ (self.r - self.center)
        r = self.r + torch.sin(angle)[:, None] * x + (1.0 - torch.cos(angle))[:, None] * (self.spin @ x)
        return quaternion_product(turn, self._p[:, None].expand(4, len(angle))).T, r

    def motion(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coordinates [times, 7], rates [times, 6] and accelerations [times, 6]; rotations in body axes."""
        if self.law is None:
            q = torch.cat([self.r, self._p])
            return q.expand(len(times), 7), q.new_zeros(len(times), 6), q.new_zeros(len(times), 6)
        angle, rate, acceleration = (x[:, None] for x in slopes_at(self.law, times))
        p, r = self.turned((angle - self.law(torch.zeros_like(times[0])))[:, 0])
        arm = (r - self.center) @ self.spin.T
        omega = (self.A.T @ self._axis).expand(len(times), 3)
        rdd = acceleration * arm + rate.square() * (arm @ self.spin.T)
        return (
            torch.cat([r, p], 1),
            torch.cat([rate * arm, rate * omega], 1),
            torch.cat([rdd, acceleration * omega], 1),
        )

    def motion_at(self, t: Any) -> tuple[Any, Any, Any]:
        """The same [components, 1, lanes] at a time [s], or at those of lanes [1 + n, lanes]; pairs if these are."""
        times = value(t)[0] if isinstance(t, Pair) else torch.as_tensor(t, dtype=torch.float64).reshape(-1)
        if not isinstance(t, Pair):
            return tuple(x.T[:, None] for x in self.motion(times))  # pyright: ignore[reportReturnType]
        values, rates = jvp(self.motion, (times,), (torch.ones_like(times),))[:2]
        moved = zip(values, rates, strict=True)
        return tuple(Pair.of(x.T[:, None], rate.T[:, None] * t.tangent) for x, rate in moved)  # pyright: ignore[reportReturnType]
