"""One lane of a motion at all times at which its state is known.

    output times, or the smaller steps by which the lane was integrated        one state
    switches between phases, each at the lane's own time                       two states at one time: before and after

Peaks, integrals, energies and plots look at these times: between them a motion is smooth.
Checked in tests/design/test_switches.py, tests/integrate/test_contacts.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.gradients import untransformed
from torchmbd.math.pair import value
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.results.history import History
from torchmbd.results.motion_data import has_failed
from torchmbd.results.time_rows import IntegratedSignals, Rows, Signals

if TYPE_CHECKING:
    from torchmbd.results.motion_data import Moment, MotionData

_SAME = 1e-9  # of an interval between two times: equal times


class LaneMotion(NamedTuple):
    """One lane at its times [n], which do not decrease.

    motion   of this lane alone, without sensitivities
    begins   which states follow upon a switch [n]
    outputs  numbers of the output times among all [times]
    """

    motion: Any
    begins: Tensor
    outputs: Tensor


def has_lane_times(motion: MotionData) -> bool:
    """True if lanes have states besides those at the output times."""
    return bool(motion.switches) or getattr(motion.signals, "at_steps", None) is not None


def has_checkpoints(motion: MotionData) -> bool:
    """True if there are steps between the states of a motion."""
    integration = motion.signals.integration if isinstance(motion.signals, IntegratedSignals) else None
    return integration is not None and integration.has_checkpoints


def lane_motion(motion: MotionData, lane: int, between: bool = False) -> LaneMotion:
    """A lane of a motion at all its times; `between`: at those of its steps between checkpoints as well, without gradients."""
    t, signals, outputs = _all_steps(motion, lane) if between else _steps(motion, lane)
    sides = [(s.t[lane], moment) for s in motion.switches for moment in (s.before, s.after)]
    begins = torch.zeros(len(t), dtype=torch.bool)
    if sides:
        t, order = _in_order(t, torch.stack([time for time, _ in sides]))
        begins = (order < len(sides)) & (order % 2 == 1)
        outputs = torch.argsort(order, stable=True)[len(sides) :][outputs]
        signals = _WithSides(signals, [moment for _, moment in sides], lane, order)
    alone = motion.one_lane(lane, t, signals)
    if motion.dynamics.known_rank is not None:  # that of all lanes, which is not computed again
        alone.dynamics.known_rank = motion.dynamics.known_rank
    return LaneMotion(alone, begins, outputs)


def _in_order(t: Tensor, sides: Tensor) -> tuple[Tensor, Tensor]:
    """Times of states and of both sides of switches, in order, and their numbers, those of the sides first.

    A state at the time of a switch is one after it. A switch that a lane does not reach comes last, at the end of the motion.
    """
    end, same = t[-1], _SAME * (t[-1] - t[0]).detach() / len(t)
    reached = torch.isfinite(sides)
    sides = torch.where(reached, sides, end)
    keys = t.detach()
    for time in sides.detach().unbind():
        keys = torch.where((keys - time).abs() <= same, time, keys)
    times = torch.cat([sides, torch.where(keys == t.detach(), t, keys)])
    keys = torch.cat([torch.where(reached, sides.detach(), torch.inf), keys])
    order = torch.argsort(keys, stable=True)
    return times.gather(0, order), order


def _steps(motion: MotionData, lane: int) -> tuple[Tensor, Signals, Tensor]:
    """Times of the steps of a lane, its rows there, and the numbers of the output times among them."""
    signals, count = motion.signals, len(motion.t)
    at_steps = signals.at_steps if isinstance(signals, IntegratedSignals) else None
    outputs = torch.arange(count)
    if at_steps is None:
        return motion.t, _Lane(signals, lane), outputs
    assert isinstance(signals, IntegratedSignals)
    of_lane = at_steps.counts[0, 0, lane].long()
    most = int(untransformed(of_lane).max())
    k = torch.arange(most).minimum(of_lane - 1)  # under torch.func.vmap the last one again where others have more
    t = motion.t[-1] * (k.double() / (of_lane - 1).double())
    data = motion.dynamics.select_lanes([lane]).data
    whole = signals.history.expansion
    expansion = None if whole is None else Expansion.of(whole.condensation, data, t)
    q, v, vd, lam = (x[..., lane : lane + 1].index_select(0, k) for x in at_steps[:4])
    segment = None if at_steps.segment is None else at_steps.segment[..., lane : lane + 1].index_select(0, k)
    history = History(q, v, vd, lam, expansion, t, segment=segment)
    valid = signals.valid_times
    if valid is not None:  # of a lane that has not failed: all
        valid = torch.where(valid >= count, most, valid)[lane : lane + 1]
    return t, IntegratedSignals(history, signals.integration, data, valid), outputs * ((of_lane - 1) // (count - 1))


def _all_steps(motion: MotionData, lane: int) -> tuple[Tensor, Signals, Tensor]:
    """As `_steps`, at all steps, which are made again where they were not kept."""
    signals, count = motion.signals, len(motion.t)
    integration = signals.integration if isinstance(signals, IntegratedSignals) else None
    sound = integration is not None and not has_failed(motion.status[lane])
    history = integration.at_all_steps(lane) if integration is not None and sound else None
    if history is None:
        return _steps(motion, lane)
    data = {name: value(x).detach() for name, x in motion.dynamics.select_lanes([lane]).data.items()}
    t = torch.linspace(0.0, float(untransformed(motion.t[-1])), len(history.q), dtype=torch.float64)
    expansion = history.expansion and Expansion.of(history.expansion.condensation, data, t)
    history = replace(history, expansion=expansion, times=t)
    return t, IntegratedSignals(history, integration, data), torch.arange(count) * ((len(t) - 1) // (count - 1))


class _Lane(Signals):
    """Rows of one lane of others."""

    def __init__(self, base: Signals, lane: int):
        super().__init__()
        self.base, self.lane = base, lane
        self.lanes, self.times = 1, base.times

    def detach(self) -> Signals:
        return _Lane(self.base.detach(), self.lane)

    def _values(self, name: str, rows: Rows) -> Tensor:
        return self.base.values(name, rows)[self.lane : self.lane + 1]


class _WithSides(Signals):
    """Rows of one lane, and of states on both sides of switches, in the order of their times.

    order   numbers of the states, those of the sides first
    """

    def __init__(self, base: Signals, sides: list[Moment], lane: int, order: Tensor):
        super().__init__()
        self.base, self.sides, self.lane, self.order = base, sides, lane, order
        self.lanes, self.times = 1, base.times + len(sides)

    def detach(self) -> Signals:
        return _WithSides(self.base.detach(), [side.detach() for side in self.sides], self.lane, self.order)

    def _values(self, name: str, rows: Rows) -> Tensor:
        x = torch.stack([getattr(side, name)[self.lane] for side in self.sides])[None]
        x = x if rows is None else x[..., list(rows)]
        return torch.cat([x, self.base.values(name, rows)], 1).index_select(1, self.order)
