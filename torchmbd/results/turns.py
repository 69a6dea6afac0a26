"""Whole turns of an angle along a motion: an angle of a state is known but for these.

    turns_{i+1} - turns_i = round( ((w_i + w_{i+1}) (t_{i+1} - t_i) / 2 - (a_{i+1} - a_i)) / 2 pi )      a angle, w its rate

Of a motion they are counted from its first time. An instant of a motion that is being integrated, as the event of a phase
sees it, continues the angle of what is recorded so far: `Turns`.
Checked in tests/design/test_angle.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.results.time_rows import TensorSignals


class AngleBefore(NamedTuple):
    """Times, angles and rates of lanes before an instant at the times `now` [lanes]; nan of a lane that begins there."""

    t: Tensor
    angle: Tensor
    rate: Tensor
    now: Tensor


def turns_between(motion: Any, angle: Tensor, rate: Tensor, before: AngleBefore | None) -> Tensor:
    """Turns to be added to angles [lanes, times] of a motion with these rates; before: of its first time."""
    first = torch.zeros_like(angle[:, :1])
    if before is not None:
        first = _turns(before.angle, before.rate, before.t, angle[:, 0], rate[:, 0], before.now)[:, None]
    if angle.shape[1] < 2:
        return first.expand_as(angle)
    t = motion.t.detach()
    steps = _turns(angle[:, :-1], rate[:, :-1], t[:-1], angle[:, 1:], rate[:, 1:], t[1:])
    return first + torch.nn.functional.pad(steps, (1, 0)).cumsum(-1)


def _turns(a0: Tensor, w0: Tensor, t0: Tensor, a1: Tensor, w1: Tensor, t1: Tensor) -> Tensor:
    """Turns from one angle to the next; 0 where they are not known."""
    return ((a0 + 0.5 * (w0 + w1) * (t1 - t0) - a1) / (2.0 * math.pi)).round().nan_to_num(0.0)


@dataclass
class Turns:
    """Angles of lanes at the recorded times of a motion that is being integrated.

    base     a motion of all lanes with the system and its designs
    times    of the record [times];  q: its coordinates [times, n, pair, lanes], nan where nothing is recorded yet
    states   q and v of the whole system [rows, n, pair, lanes] at some of these times
    lanes    those of an instant;  now: its times [lanes], or [1] for all
    """

    base: Any
    times: Tensor
    q: Tensor
    states: Callable[[Tensor], tuple[Tensor, Tensor]]
    lanes: list[int] = field(default_factory=list)
    now: Tensor | None = None
    _angles: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def of_lanes(self, lanes: list[int]) -> Turns:
        """Of some of these lanes."""
        return replace(self, lanes=[self.lanes[lane] for lane in lanes] if self.lanes else lanes)

    def at(self, now: Tensor) -> Turns:
        """For an instant at these times [lanes], or [1]."""
        return replace(self, now=now.detach())

    @torch.no_grad()
    def before(self, angle: Any) -> AngleBefore:
        """The last recorded angles before the instant, of a history `angle`."""
        assert self.now is not None
        lanes = torch.tensor(self.lanes or range(self.q.shape[-1]))
        now = self.now.expand(len(lanes))
        same = 1e-9 * float(self.times[-1]) / len(self.times)
        last = torch.searchsorted(self.times, (now - same).contiguous()) - 1
        angles, rates = self._up_to(angle, int(last.max()) + 1)
        known = torch.isfinite(angles[:, lanes]) & (torch.arange(len(self.times))[:, None] <= last)
        row = torch.where(known, torch.arange(len(self.times))[:, None], -1).amax(0)
        t = torch.where(row < 0, torch.nan, self.times[row.clamp_min(0)])
        return AngleBefore(t, angles[row.clamp_min(0), lanes], rates[row.clamp_min(0), lanes], now)

    def _up_to(self, angle: Any, count: int) -> tuple[Tensor, Tensor]:
        """Continuous angles and rates [times, lanes] at the first `count` times, nan where nothing is recorded."""
        nothing = torch.full((len(self.times), self.q.shape[-1]), torch.nan, dtype=torch.float64)
        angles, rates = self._angles.setdefault(repr(angle), (nothing, nothing.clone()))
        new = torch.isfinite(self.q[:count, 0, 0]) & ~torch.isfinite(angles[:count])
        rows = torch.nonzero(new.any(1))[:, 0]
        if not len(rows):
            return angles, rates
        x = {name: y[:, :, 0].permute(2, 0, 1) for name, y in zip(("q", "v"), self.states(rows), strict=True)}
        recorded = replace(self.base, t=self.times[rows], signals=TensorSignals(x), turns=None, known=None)
        wrapped, wrapped_rates = (y.detach().T for y in angle.wrapped_jet(recorded))
        for i, a, w in zip(rows.tolist(), wrapped, wrapped_rates, strict=True):
            known = torch.isfinite(angles[:i])
            lanes = torch.arange(len(a))
            row = torch.where(known, torch.arange(i)[:, None], 0).amax(0) if i else torch.zeros_like(lanes)
            turns = _turns(angles[row, lanes], rates[row, lanes], self.times[row], a, w, self.times[i])
            angles[i] = torch.where(new[i], a + 2.0 * math.pi * turns, angles[i])
            rates[i] = torch.where(new[i], w, rates[i])
        return angles, rates
