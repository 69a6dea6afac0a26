"""Rows of the coordinates, rates, accelerations and multipliers of a motion, made only on demand.

    values(name, rows)     [lanes, times, k]
    tangents(name, rows)   [lanes, times, k, n_b], None without sensitivities

`IntegratedSignals` has the states that an integrator left, `TensorSignals` tensors, `SomeTimes` a part of others.
Names are "q", "v", "a" and "lam"; rows None: all. Each result is kept.
Checked in tests/results/test_time_rows.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchmbd.math.gradients import all_true
from torchmbd.math.pair import Pair
from torchmbd.math.row_selection import lanes_first
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.multibody.saddle.rank import Rank
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History

ORDERS = ("q", "v", "a")
Rows = Sequence[int] | None


class Signals:
    """See the module header."""

    lanes: int
    times: int

    def __init__(self) -> None:
        self._kept: dict[tuple, Tensor | None] = {}

    def values(self, name: str, rows: Rows = None) -> Tensor:
        """[lanes, times, k]."""
        result = self._once("values", name, rows)
        assert result is not None
        return result

    def tangents(self, name: str, rows: Rows = None) -> Tensor | None:
        """[lanes, times, k, n_b]."""
        return self._once("tangents", name, rows)

    def _once(self, kind: str, name: str, rows: Rows) -> Tensor | None:
        key = (kind, name, None if rows is None else tuple(rows), torch.is_grad_enabled())
        if key not in self._kept:
            self._kept[key] = getattr(self, f"_{kind}")(name, rows)
        return self._kept[key]

    def detach(self) -> Signals:
        """The same numbers without a graph of torch."""
        raise NotImplementedError(type(self).__name__)

    def _values(self, name: str, rows: Rows) -> Tensor:
        raise NotImplementedError(type(self).__name__)

    def _tangents(self, name: str, rows: Rows) -> Tensor | None:
        return None


class TensorSignals(Signals):
    """Tensors of all rows [lanes, times, n], without tangents."""

    def __init__(self, values: Mapping[str, Tensor]):
        super().__init__()
        self._all = dict(values)
        self.lanes, self.times = values["q"].shape[:2]

    def detach(self) -> TensorSignals:
        return TensorSignals({name: x.detach() for name, x in self._all.items()})

    def _values(self, name: str, rows: Rows) -> Tensor:
        return self._all[name] if rows is None else self._all[name][..., list(rows)]


class SomeTimes(Signals):
    """Rows of other signals at some of their times, without tangents."""

    def __init__(self, signals: Signals, chosen: slice):
        super().__init__()
        self.signals, self.chosen = signals, chosen
        self.lanes, self.times = signals.lanes, len(range(signals.times)[chosen])

    def _values(self, name: str, rows: Rows) -> Tensor:
        return self.signals.values(name, rows)[:, self.chosen]


class Integration(Protocol):
    """How a motion was integrated.

    variables        names of the inputs whose tangents were integrated along
    history          states of all lanes;  dynamics: the equations of motion for these designs
    validity         how many times of each lane have numbers that count, and 1, or 0 where it has failed [2, 1, lanes]
    expansion        leads from the states to those of the whole system, as a function of the data; None: they are the whole
    multipliers      those of all constraints [times, rows, pair, lanes] out of those that were integrated
    ranks            of the constraints that act in each part of the motion
    rows_at          the constraint rows that act on a lane at a time [s]
    has_checkpoints  whether there are steps between the states that are kept
    at_all_steps     the states of one lane at all its steps; None: all were kept
    """

    @property
    def variables(self) -> tuple[str, ...]: ...

    @property
    def history(self) -> History: ...

    @property
    def dynamics(self) -> Dynamics: ...

    @property
    def validity(self) -> Tensor: ...

    @property
    def ranks(self) -> Sequence[Rank]: ...

    @property
    def has_checkpoints(self) -> bool: ...

    def rows_at(self, lane: int, t: float) -> list[int]: ...

    def expansion(self, data: dict[str, Any]) -> Expansion | None: ...

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor: ...

    def at_all_steps(self, lane: int) -> History | None: ...


class StepStates(NamedTuple):
    """States at the times of the steps by which each lane was integrated, differentiable as the motion is.

    q, v, vd, lam   [most, n, 1, lanes], without meaning beyond the last time of a lane;  counts: of times [1, 1, lanes]
    segment         as in `History` [most, 1, lanes]
    """

    q: Tensor
    v: Tensor
    vd: Tensor
    lam: Tensor
    counts: Tensor
    segment: Tensor | None = None

    def detach(self) -> StepStates:
        """The same numbers without a graph of torch."""
        return self._replace(**{name: x.detach() for name, x in self._asdict().items() if x is not None})


class IntegratedSignals(Signals):
    """Rows of a history, as functions of its tensors; chosen rows lie side by side in memory, all of them are views.

    integration   gives the multipliers of all constraints as a function of the data; None: the history has them
    valid_times   how many times of each lane have numbers [lanes]: those after a failure are nan; None: all
    at_steps      where steps of some lanes are smaller than intervals between times; None: in no lane
    """

    def __init__(
        self,
        history: History,
        integration: Integration | None = None,
        data: dict[str, Any] | None = None,
        valid_times: Tensor | None = None,
        at_steps: StepStates | None = None,
    ):
        super().__init__()
        self.at_steps = at_steps
        self.history, self.integration, self.data, self.valid_times = history, integration, data or {}, valid_times
        self.times, _, pair, self.lanes = history.q.shape
        self.has_tangents = pair > 1
        self._all_multipliers: dict[bool, Tensor] = {}

    def detach(self) -> IntegratedSignals:
        h, data = self.history, {name: detached(x) for name, x in self.data.items()}
        times, segment = (None if x is None else x.detach() for x in (h.times, h.segment))
        q, v, vd, lam = (x.detach() for x in h.states)
        plain = History(q, v, vd, lam, h.expansion_by(data), times, segment=segment)
        at_steps = None if self.at_steps is None else self.at_steps.detach()
        return IntegratedSignals(plain, self.integration, data, self.valid_times, at_steps)

    def _values(self, name: str, rows: Rows) -> Tensor:
        x = self._of(name, rows, slice(1))
        return x.squeeze(2).permute(2, 0, 1) if rows is None else lanes_first(x)

    def _tangents(self, name: str, rows: Rows) -> Tensor | None:
        if not self.has_tangents:
            return None
        x = self._of(name, rows, slice(1, None)).permute(3, 0, 1, 2)
        return x if rows is None else x.contiguous()

    def _of(self, name: str, rows: Rows, pair: slice) -> Tensor:
        x = self._whole(name, rows, pair)
        if self.valid_times is None or all_true(self.valid_times >= self.times):
            return x
        lost = torch.arange(self.times)[:, None] >= self.valid_times
        return x.masked_fill(lost[:, None, None], torch.nan)

    def _whole(self, name: str, rows: Rows, pair: slice) -> Tensor:
        if name == "lam":
            mode, h = torch.is_grad_enabled(), self.history
            if mode not in self._all_multipliers:  # of all rows, kept for each grad mode
                source = self.integration
                self._all_multipliers[mode] = h.multipliers if source is None else source.multipliers(h, self.data)
            x = self._all_multipliers[mode][:, :, pair]
            return x if rows is None else x[:, list(rows)]
        return self.history.rows(ORDERS.index(name), rows, pair)


def detached(x: Any) -> Any:
    """A number without a graph of torch."""
    return Pair(x.full.detach()) if isinstance(x, Pair) else x.detach()
