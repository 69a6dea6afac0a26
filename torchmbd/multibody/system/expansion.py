"""The whole system's coordinates and multipliers from those of the system that a condensation left.

    bodies that were left    their own rows; rates through the constant map of guided bodies
    prescribed bodies                 known motions: they have no design tangents
    multipliers of rows that went: reactions.py

By rows, on demand: most of a motion is never read.
Checked in tests/multibody/system/test_condensation.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.multibody.system.condensation import Condensation, component_rows
from torchmbd.multibody.system.equations import Data
from torchmbd.multibody.system.reactions import multipliers


@dataclass(frozen=True, eq=False)
class Expansion:
    """Of one motion: `data` of the whole system, output times [times]."""

    condensation: Condensation
    data: Data
    times: Tensor
    known: list[
        tuple[int, tuple[Tensor, ...]]
    ]  # number of each prescribed body in the whole, and its q, v, a [times, components]

    @classmethod
    def of(cls, c: Condensation, data: Data, times: Tensor) -> Expansion:
        """Asks the laws of the prescribed bodies now: they may be others later."""
        known = [
            (c.whole.names.index(prescribed_body.name), prescribed_body.motion(times))
            for prescribed_body in c.topology.prescribed_bodies
        ]
        return cls(c, data, times, known)

    def rows(self, order: int, x: Tensor, index: Sequence[int] | None = None, known: bool = True) -> Tensor:
        """Rows of q (order 0), v (1) or a (2) [times, k, pair, lanes] of the whole out of x of what was left.

        index   rows of the whole; None: all
        known   whether the first of the pair axis are values, and the others tangents; False: all are tangents
        """
        c, each = self.condensation, 6 if order else 7
        own = component_rows(c.whole, c.bodies, each).tolist()
        total = each * c.whole.bodies + c.whole.modes * c.whole.flexible
        wanted = [row % total for row in (range(total) if index is None else index)]
        place = {row: i for i, row in enumerate(own)}
        found = [place[row] for row in wanted if row in place]
        y = _picked(c.topology.spread if order else None, x, found)
        if len(found) == len(wanted):
            return y
        result = y.new_zeros(len(x), len(wanted), *x.shape[2:])
        result[:, [i for i, row in enumerate(wanted) if row in place]] = y
        for number, motion in self.known if known else ():
            for i, row in enumerate(wanted):
                component, body = divmod(row, c.whole.bodies)
                if body == number and component < each:
                    result[:, i, 0] = motion[order][:, component, None]
        return result

    def multipliers(self, q: Tensor, v: Tensor, a: Tensor, lam: Tensor) -> Tensor:
        """All multipliers [times, rows, pair, lanes] from q, v, a and multipliers of what was left."""
        q, v, a = (self.rows(order, x) for order, x in enumerate((q, v, a)))
        return multipliers(self.condensation, self.data, self.times, q, v, a, lam)


def _picked(spread, x: Tensor, rows: list[int]) -> Tensor:
    """Rows of x [times, k, pair, lanes], or of what a map makes of it."""
    if spread is not None:
        y = spread.select_rows(rows)(x.transpose(0, 1).flatten(1, 2))
        return y.unflatten(1, (x.shape[0], x.shape[2])).transpose(0, 1)
    return select_rows(x, rows)


def select_rows(x: Tensor, rows: Sequence[int]) -> Tensor:
    """Rows of x [times, k, pair, lanes]."""
    return x.index_select(1, torch.tensor(rows, dtype=torch.long))
