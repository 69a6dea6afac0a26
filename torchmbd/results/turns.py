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
    _known: dict[str, _Known] = field(default_factory=dict)

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
        known = self._up_to(angle, int(last.max()) + 1)
        row = known.rows(lanes, last)
        at, none = row.clamp_min(0), row < 0
        t = torch.where(none, torch.nan, self.times[at])
        return AngleBefore(t, known.angles[at, lanes], known.rates[at, lanes], now)

    def _up_to(self, angle: Any, count: int) -> _Known:
        """Angles at the first `count` times, as far as these are recorded."""
        known = self._known.get(repr(angle)) or _Known.nothing(*self.q[:, 0, 0].shape)
        self._known[repr(angle)] = known
        first = int(known.last.min()) + 1
        new = torch.isfinite(self.q[first:count, 0, 0]) & ~torch.isfinite(known.angles[first:count])
        rows = first + torch.nonzero(new.any(1))[:, 0]
        if not len(rows):
            return known
        x = {name: y[:, :, 0].permute(2, 0, 1) for name, y in zip(("q", "v"), self.states(rows), strict=True)}
        recorded = replace(self.base, t=self.times[rows], signals=TensorSignals(x), turns=None, known=None)
        known.add(rows, new[rows - first], self.times, *(y.detach().T for y in angle.wrapped_jet(recorded)))
        return known


@dataclass
class _Known:
    """Continuous angles and rates [times, lanes], nan where nothing is recorded; last: row of the last of each lane, or -1."""

    angles: Tensor
    rates: Tensor
    last: Tensor

    @classmethod
    def nothing(cls, times: int, lanes: int) -> _Known:
        nan = torch.full((times, lanes), torch.nan, dtype=torch.float64)
        return cls(nan, nan.clone(), torch.full((lanes,), -1))

    def rows(self, lanes: Tensor, most: Tensor) -> Tensor:
        """The last rows of lanes that are known, up to rows `most` [lanes]; -1 where none is."""
        row = torch.minimum(self.last[lanes], most)
        there = (row < 0) | torch.isfinite(self.angles[row.clamp_min(0), lanes])
        if bool(there.all()):
            return row
        numbers = torch.arange(int(row.max()) + 1)[:, None]  # a lane has a gap
        known = torch.isfinite(self.angles[: len(numbers), lanes]) & (numbers <= row)
        return torch.where(known, numbers, -1).amax(0)

    def add(self, rows: Tensor, new: Tensor, times: Tensor, angles: Tensor, rates: Tensor) -> None:
        """Add angles within half a turn, and their rates [rows, lanes], where they are new; each lane is recorded in order."""
        lanes, numbers = torch.arange(len(self.last)), torch.arange(1, len(rows) + 1)[:, None]
        at, begun = self.last.clamp_min(0), self.last >= 0  # row 0: of what is known already
        angles, rates = (
            torch.cat([self.angles[at, lanes][None], angles]),
            torch.cat([self.rates[at, lanes][None], rates]),
        )
        t = torch.cat([times[at][None], times[rows, None].expand(-1, len(lanes))])
        here = torch.cat([torch.where(begun, 0, -1)[None], torch.where(new, numbers, -1)]).cummax(0).values
        before = here[:-1]  # the last number that is known before each row
        a, w, s = (x.gather(0, before.clamp_min(0)) for x in (angles, rates, t))
        steps = torch.where(new & (before >= 0), _turns(a, w, s, angles[1:], rates[1:], t[1:]), 0.0)
        continuous = angles[1:] + 2.0 * math.pi * steps.cumsum(0)
        self.angles[rows] = torch.where(new, continuous, self.angles[rows])
        self.rates[rows] = torch.where(new, rates[1:], self.rates[rows])
        self.last = torch.where(here[-1] > 0, rows[here[-1].clamp_min(1) - 1], self.last)
