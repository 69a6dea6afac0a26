"""A motion as it is shown: q, v, a and multipliers by rows, made only on demand.

    values(name, rows)     [lanes, times, k]
    tangents(name, rows)   [lanes, times, k, n_b], None without sensitivities

`Recorded` reads what an integrator left; `Given` holds tensors.
Names are "q", "v", "a" and "lam"; rows None: all. What was asked for once is kept.
Checked in tests/results/test_time_rows.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from torchmbd.math.gradients import all_true
from torchmbd.math.pair import Pair
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
        found = self._once("values", name, rows)
        assert found is not None
        return found

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


class Given(Signals):
    """Tensors of all rows, as they are shown; tangents by the same names, if there are any."""

    def __init__(self, values: Mapping[str, Tensor], tangents: Mapping[str, Tensor | None] | None = None):
        super().__init__()
        self._all, self._slopes = dict(values), dict(tangents or {})
        self.lanes, self.times = values["q"].shape[:2]

    def detach(self) -> Given:
        """As of Signals."""
        return Given({name: x.detach() for name, x in self._all.items()})

    def _values(self, name: str, rows: Rows) -> Tensor:
        return self._all[name] if rows is None else self._all[name][..., list(rows)]

    def _tangents(self, name: str, rows: Rows) -> Tensor | None:
        slopes = self._slopes.get(name)
        return slopes if slopes is None or rows is None else slopes[..., list(rows), :]


class Multipliers(Protocol):
    """Makes the multipliers [times, rows, pair, lanes] that are shown of those that were integrated."""

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor: ...


class Recorded(Signals):
    """What an integrator left, as functions of its tensors; chosen rows lie side by side in memory, all of them are views.

    settle   makes the multipliers that are shown, of the data; None: they are those that were integrated
    until    how many times of each lane have numbers [lanes]: what comes after a failure is nan; None: all
    """

    def __init__(
        self,
        history: History,
        settle: Multipliers | None = None,
        data: dict[str, Any] | None = None,
        until: Tensor | None = None,
    ):
        super().__init__()
        self.history, self.settle, self.data, self.until = history, settle, data or {}, until
        self.times, _, pair, self.lanes = history.q.shape
        self.moving = pair > 1
        self._settled: dict[bool, Tensor] = {}

    def detach(self) -> Recorded:
        """As of Signals."""
        h, data = self.history, {name: detached(x) for name, x in self.data.items()}
        expansion = None if h.expansion is None else replace(h.expansion, data=data)
        plain = History(
            h.q.detach(),
            h.v.detach(),
            h.vd.detach(),
            h.lam.detach(),
            expansion,
            None if h.times is None else h.times.detach(),
        )
        return Recorded(plain, self.settle, data, self.until)

    def _values(self, name: str, rows: Rows) -> Tensor:
        x = self._of(name, rows, slice(1))[:, :, 0].permute(2, 0, 1)
        return x if rows is None else x.contiguous()

    def _tangents(self, name: str, rows: Rows) -> Tensor | None:
        if not self.moving:
            return None
        x = self._of(name, rows, slice(1, None)).permute(3, 0, 1, 2)
        return x if rows is None else x.contiguous()

    def _multipliers(self) -> Tensor:
        """Kept for each grad mode."""
        mode = torch.is_grad_enabled()
        if mode not in self._settled:
            h = self.history
            self._settled[mode] = h.multipliers if self.settle is None else self.settle.multipliers(h, self.data)
        return self._settled[mode]

    def _of(self, name: str, rows: Rows, pair: slice) -> Tensor:
        x = self._whole(name, rows, pair)
        if self.until is None or all_true(self.until >= self.times):
            return x
        lost = torch.arange(self.times)[:, None] >= self.until
        return x.masked_fill(lost[:, None, None], torch.nan)

    def _whole(self, name: str, rows: Rows, pair: slice) -> Tensor:
        if name == "lam":
            x = self._multipliers()[:, :, pair]
            return x if rows is None else x[:, list(rows)]
        return self.history.rows(ORDERS.index(name), rows, pair)


def detached(x: Any) -> Any:
    """A number without a graph of torch."""
    return Pair(x.full.detach()) if isinstance(x, Pair) else x.detach()
