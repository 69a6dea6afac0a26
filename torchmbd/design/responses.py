"""The responses: histories of a motion, and measures of histories.

    StrainEnergy(body)   U = 1/2 w' Kr w                        [J]     eq. (17)
    Integral(history)    trapezoidal rule over the output times         eq. (21)
    Max(history)         the peak, located between the output times     eq. (18)

The peak of a sampled history is that of a cubic spline with slopes from fourth-order differences; its gradient is that
of the spline at the located time (envelope theorem), so value and gradient belong together, and both stay continuous when
the peak moves past a sample. The gradient taken at the best sample is 2 % off at 500 samples.
Checked in tests/contracts/test_responses.py against differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.design.response import History, Measure, Valued
from torchmbd.errors import InputError
from torchmbd.integrators import Trajectory
from torchmbd.system import System


@dataclass(frozen=True)
class StrainEnergy(History):
    """Elastic energy of a flexible body."""

    body: str

    def check(self, system: System) -> None:
        if not hasattr(system.body(self.body), "mesh"):
            raise InputError(f"body {self.body!r} is rigid; allowed here: a flexible body")

    def series(self, motion: Trajectory) -> Valued:
        body = motion.body(self.body)
        w, (K, dK), dw = body.w, body.stiffness, body.dw_db
        force = w @ K
        U = 0.5 * (force * w).sum(-1)
        if dw is None:
            return Valued(U, None)
        gradient = torch.einsum("lti,ltib->ltb", force, dw)
        if dK is not None:
            gradient = gradient + 0.5 * torch.einsum("lti,lijb,ltj->ltb", w, dK, w)
        return Valued(U, gradient)


@dataclass(frozen=True)
class Integral(Measure):
    """Integral of a history over the simulated time."""

    history: History

    def check(self, system: System) -> None:
        self.history.check(system)

    def of(self, motion: Trajectory) -> Valued:
        y, dy = self.history.series(motion)
        return Valued(torch.trapezoid(y, motion.t, dim=1), None if dy is None else torch.trapezoid(dy, motion.t, dim=1))


@dataclass(frozen=True)
class Max(Measure):
    """Largest value of a history over the simulated time, located between the samples."""

    history: History

    def check(self, system: System) -> None:
        self.history.check(system)

    def of(self, motion: Trajectory) -> Valued:
        y, dy = self.history.series(motion)
        start, weights = _peak(y)
        value = (_ends(y, start) * weights).sum(-1)
        if dy is None:
            return Valued(value, None)
        return Valued(value, (_ends(dy.movedim(1, -1), start[:, None]) * weights[:, None]).sum(-1))


def _slopes(y: Tensor) -> Tensor:
    """Slopes per sample interval [..., times], of fourth order inside, of second at the ends."""
    if y.shape[-1] < 5:
        return torch.gradient(y, dim=-1)[0]
    first, last = y[..., :3], y[..., -3:]
    forward, backward = y.new_tensor([-1.5, 2.0, -0.5]), y.new_tensor([0.5, -2.0, 1.5])
    inner = (8.0 * (y[..., 3:-1] - y[..., 1:-3]) - (y[..., 4:] - y[..., :-4])) / 12.0
    ends = [
        (first @ forward),
        (first[..., 2] - first[..., 0]) / 2.0,
        (last[..., 2] - last[..., 0]) / 2.0,
        last @ backward,
    ]
    return torch.cat([ends[0][..., None], ends[1][..., None], inner, ends[2][..., None], ends[3][..., None]], -1)


def _ends(y: Tensor, start: Tensor) -> Tensor:
    """Values and slopes at the ends of the intervals that begin at sample `start`: [..., 4]."""
    index = torch.stack([start, start + 1], -1).expand(*y.shape[:-1], 2)
    return torch.cat([torch.gather(y, -1, index), torch.gather(_slopes(y), -1, index)], -1)


def _peak(y: Tensor) -> tuple[Tensor, Tensor]:
    """The interval of the peak of y [lanes, times], and the Hermite weights [lanes, 4] of its ends (see `_ends`)."""
    n = y.shape[1]
    best = y.argmax(1)
    rising = torch.gather(_slopes(y), 1, best[:, None])[:, 0] > 0
    start = torch.where(rising, best, best - 1).clamp(0, n - 2)
    y0, y1, m0, m1 = _ends(y, start).unbind(1)
    a, b = 2.0 * (y0 - y1) + m0 + m1, 3.0 * (y1 - y0) - 2.0 * m0 - m1
    # 3 a s^2 + 2 b s + m0 = 0, the root of the maximum. Without one inside, the history ends while it rises or falls.
    inside = (m0 > 0) & (m1 < 0)
    root = torch.sqrt(torch.where(inside, b * b - 3.0 * a * m0, 1.0))
    s = torch.where(inside, m0 / torch.where(inside, root - b, 1.0), (best - start).to(y.dtype))
    s2, s3 = s * s, s * s * s
    return start, torch.stack([2 * s3 - 3 * s2 + 1, 3 * s2 - 2 * s3, s3 - 2 * s2 + s, s3 - s2], 1)


RESPONSES: dict[str, type[History]] = {"strain_energy": StrainEnergy}
COMBINATORS: dict[str, type[Measure]] = {"integral": Integral, "max": Max}
