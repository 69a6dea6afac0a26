"""States of a motion as an integrator leaves them: numbers [times, component, 1 + n_b, lanes], values, then design tangents.

Of a condensed system only its own coordinates are kept; rows of the whole system are made on demand (time_rows.py), for
few of them are read.
Checked in tests/results/test_time_rows.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.pair import Pair, value
from torchmbd.math.row_selection import select_rows
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.multibody.saddle.least_norm import LeastNorm
from torchmbd.results.state import State

SEGMENT = 2000  # steps


class RefinedLane(NamedTuple):
    """A lane that was integrated again, by smaller steps or with a renewed iteration matrix.

    history    with all of these steps;  lane: its number there
    substeps   intervals there for each of the batch
    """

    history: History
    lane: int
    substeps: int


@dataclass
class History:
    """States that an integrator leaves.

    expansion     leads to the whole system; None: it is the whole
    times         [times] [s]; None: equal intervals over the duration
    refined       lanes that were integrated again, mostly by smaller steps
    segment       number of the segment that each state is in, -1: in none [times, 1, lanes]; None: all have the same
                  equations
    run           that made them (integrate/phases/run.py); None: these states are a part of another history
    """

    q: Tensor
    v: Tensor
    vd: Tensor
    lam: Tensor
    expansion: Expansion | None = None
    times: Tensor | None = None
    refined: dict[int, RefinedLane] = field(default_factory=dict)
    segment: Tensor | None = None
    run: Any = None

    @property
    def states(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """q, v, v' and lam."""
        return self.q, self.v, self.vd, self.lam

    @property
    def has_smaller_steps(self) -> bool:
        """True if there are states of some lanes between the times of the batch."""
        return any(len(refined.history.q) > len(self.q) for refined in self.refined.values())

    def at_steps(self) -> list[Tensor]:
        """The states of lanes at the times of the steps of each; [] unless some lanes have smaller ones.

        q, v, v', lam [most, n, pair, lanes], zero beyond the last time of a lane, how many times it has [1, 1, lanes], and,
        of several segments, the segment of each state [most, 1, lanes].
        """
        if not self.has_smaller_steps:
            return []
        counts = torch.full((1, 1, self.q.shape[-1]), float(len(self.q)), dtype=torch.float64)
        for lane, refined in self.refined.items():
            counts[..., lane] = len(refined.history.q)
        states = [*self.states, *([] if self.segment is None else [self.segment])]
        most, result = int(counts.max()), []
        for k, x in enumerate(states):
            steps = x.new_zeros(most, *x.shape[1:])
            steps[: len(x)] = x
            for lane, (history, source, _) in self.refined.items():
                state = history.segment if k == len(self.states) else history.states[k]
                assert state is not None
                steps[: len(state), ..., lane] = state[..., source]
            result.append(steps)
        return [*result[:4], counts, *result[4:]]

    def at(self, times: slice) -> History:
        """The states of some of the times, without an expansion."""
        return History(self.q[times], self.v[times], self.vd[times], self.lam[times])

    def rows(self, order: int, rows: Sequence[int] | None = None, pair: slice = slice(None)) -> Tensor:
        """Rows of q (order 0), v (1) or a (2) of the whole [times, k, pair, lanes]."""
        x = (self.q, self.v, self.vd)[order]
        x = x if pair == slice(1) and x.shape[2] == 1 else x[:, :, pair]
        if self.expansion is not None:
            return self.expansion.rows(order, x, rows, values=not pair.start)
        return x if rows is None else select_rows(x, rows)

    @property
    def multipliers(self) -> Tensor:
        """Of all constraints [times, rows, pair, lanes]."""
        if self.expansion is None:
            return self.lam
        return self.expansion.multipliers(self.q, self.v, self.vd, self.lam)

    def expansion_by(self, data: Data) -> Expansion | None:
        """Leads to the whole system as a function of its data; None: it is the whole."""
        return None if self.expansion is None else replace(self.expansion, data=data)

    def least_norm_multipliers(self, least: LeastNorm | None, duration: float, data: Data) -> Tensor:
        """Multipliers of all constraints [times, rows, pair, lanes]; of redundant rows those of least norm."""
        if least is None:
            return self.multipliers
        times = self.times
        if times is None:
            times = torch.linspace(0.0, duration, len(self.q), dtype=torch.float64)
        return least.at_times(data, times, self.rows(0), self.multipliers)

    @classmethod
    def of(cls, states: list[State]) -> History:
        """Stack states."""
        record = Record(states[0], len(states))
        for i, x in enumerate(states):
            record.put(i, x)
        return record.history()


class Record:
    """States of a motion in arrays of their final size, filled as they come."""

    def __init__(self, x: State, count: int):
        shapes = [y.shape for y in (x.q, x.v, x.vd, x.lam)]
        lanes = max(shape[-1] for shape in shapes)
        self.parts = [value(x.q).new_empty(count, *shape[:-1], lanes) for shape in shapes]

    @classmethod
    def of_dynamics(cls, dynamics: Any, count: int) -> Record:
        """For states of all lanes of these dynamics; nan so far."""
        T, shape = dynamics.topology, (1 + dynamics.tangents, dynamics.lanes)
        nothing = [torch.full((n, *shape), torch.nan, dtype=torch.float64) for n in (T.n_q, T.n_v, T.rows)]
        q, v, lam = (x if x.shape[-2] == 1 else Pair(x) for x in nothing)
        record = cls(State(q, v, v, v, lam), count)
        for part in record.parts:
            part.fill_(torch.nan)
        return record

    def put(self, i: int, x: State) -> None:
        """Keep the state of time i."""
        for part, y in zip(self.parts, (x.q, x.v, x.vd, x.lam), strict=True):
            part[i] = y.full if isinstance(y, Pair) else y

    def put_rates(self, i: int, v: Any) -> None:
        """Keep other rates at time i."""
        self.parts[1][i] = v.full if isinstance(v, Pair) else v

    def put_all(self, i: int, states: History) -> None:
        """Keep the states of time i and of those after it."""
        for part, y in zip(self.parts, (states.q, states.v, states.vd, states.lam), strict=True):
            part[i : i + len(y)] = y

    def history(self, expansion: Expansion | None = None) -> History:
        """What was kept."""
        q, v, vd, lam = self.parts
        return History(q, v, vd, lam, expansion)


def longest_run(every: int) -> int:
    """The most steps of one run: SEGMENT or less, but at least `every`, of which it is a multiple."""
    return every * max(SEGMENT // every, 1)


def segments(steps: int, every: int = 1) -> list[range]:
    """All steps, in runs of `longest_run(every)` and a last one that may be shorter."""
    most = longest_run(every)
    return [range(i, min(i + most, steps)) for i in range(0, steps, most)]
