"""The responses: histories of a motion, and measures of histories.

    StrainEnergy(body)   U = 1/2 w' Kr w                        [J]     eq. (17)
    Integral(history)    trapezoidal rule over the output times         eq. (21)
    Max(history)         the peak, located between the output times     eq. (18)

The peak of a sampled history is the vertex of the parabola through the largest sample and its neighbors; its gradient is
that of the interpolated history at the located time (envelope theorem), so value and gradient belong together. The
gradient taken at the best sample is 2 % off at 500 samples.
Checked in tests/contracts/test_responses.py against differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.design.response import History, Measure, Valued
from torchmbd.integrators import Trajectory


@dataclass(frozen=True)
class StrainEnergy(History):
    """Elastic energy of a flexible body."""

    body: str

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

    def of(self, motion: Trajectory) -> Valued:
        y, dy = self.history.series(motion)
        return Valued(
            torch.trapezoid(y, motion.t, dim=1), None if dy is None else torch.trapezoid(dy, motion.t, dim=1)
        )


@dataclass(frozen=True)
class Max(Measure):
    """Largest value of a history over the simulated time, located between the samples."""

    history: History

    def of(self, motion: Trajectory) -> Valued:
        y, dy = self.history.series(motion)
        index, weights = _peak(y)
        value = (torch.gather(y, 1, index) * weights).sum(1)
        if dy is None:
            return Valued(value, None)
        picked = torch.gather(dy, 1, index[:, :, None].expand(-1, -1, dy.shape[2]))
        return Valued(value, (picked * weights[:, :, None]).sum(1))


def _peak(y: Tensor) -> tuple[Tensor, Tensor]:
    """Three samples around the largest one [lanes, 3] and the weights that interpolate its peak.

    At an end of the time interval, or where the three samples do not bend downwards, the sample itself is the peak.
    """
    n = y.shape[1]
    best = y.argmax(1, keepdim=True)
    index = best + torch.arange(-1, 2, device=y.device)
    inside = (best > 0) & (best < n - 1)
    index = index.clamp(0, n - 1)
    left, middle, right = torch.gather(y, 1, index).unbind(1)
    bend = left - 2.0 * middle + right
    curved = inside[:, 0] & (bend < 0)
    s = torch.where(curved, 0.5 * (left - right) / torch.where(curved, bend, 1.0), 0.0)
    return index, torch.stack([0.5 * s * (s - 1.0), 1.0 - s * s, 0.5 * s * (s + 1.0)], 1)


RESPONSES: dict[str, type[History]] = {"strain_energy": StrainEnergy}
COMBINATORS: dict[str, type[Measure]] = {"integral": Integral, "max": Max}
