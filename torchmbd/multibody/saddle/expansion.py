"""Coordinates and multipliers of the whole system from those of its condensed system (condensation.py).

    retained bodies                rows of the condensed system; rates by the constant map `Topology.spread`
    prescribed bodies              their known motions, which have no design tangents
    multipliers of removed rows    reactions.py

Rows are computed on demand, as most of a motion is never read.
Checked in tests/multibody/saddle/test_condensation.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.multibody.equations.equations import Data
from torchmbd.multibody.saddle.condensation import Condensation, component_count, component_rows
from torchmbd.multibody.saddle.reactions import multipliers


@dataclass(frozen=True, eq=False)
class Expansion:
    """The expansion of one motion of a condensed system.

    data         data of the whole system
    times        output times [times]
    prescribed   number of each prescribed body in the whole system, and its q, v, a [times, components]
    """

    condensation: Condensation
    data: Data
    times: Tensor
    prescribed: list[tuple[int, tuple[Tensor, ...]]]

    @classmethod
    def of(cls, c: Condensation, data: Data, times: Tensor) -> Expansion:
        """The expansion with the present laws of the prescribed bodies, which users may change later."""
        prescribed = [(c.whole.names.index(body.name), body.motion(times)) for body in c.topology.prescribed_bodies]
        return cls(c, data, times, prescribed)

    def rows(self, order: int, x: Tensor, index: Sequence[int] | None = None, values: bool = True) -> Tensor:
        """Rows of q (order 0), v (1) or a (2) [times, k, pair, lanes] of the whole system, from x of the condensed one.

        index    rows of the whole system, from its end if negative, as for a tensor; None: all
        values   whether the first entry of the pair axis is a value, and the others tangents; False: all are tangents
        """
        c, components = self.condensation, 6 if order else 7
        retained = component_rows(c.whole, c.bodies, components).tolist()
        every = range(component_count(c.whole, components))
        selected = [every[row] for row in (every if index is None else index)]
        position = {row: i for i, row in enumerate(retained)}
        positions = [position[row] for row in selected if row in position]
        y = _map_and_select(c.topology.spread if order else None, x, positions)
        if len(positions) == len(selected):
            return y
        result = y.new_zeros(len(x), len(selected), *x.shape[2:])
        result[:, [i for i, row in enumerate(selected) if row in position]] = y
        for number, motion in self.prescribed if values else ():
            for i, row in enumerate(selected):
                component, body = divmod(row, c.whole.bodies)
                if body == number and component < components:
                    result[:, i, 0] = motion[order][:, component, None]
        return result

    def multipliers(self, q: Tensor, v: Tensor, a: Tensor, lam: Tensor) -> Tensor:
        """All multipliers [times, rows, pair, lanes], from q, v, a and lam of the condensed system."""
        q, v, a = (self.rows(order, x) for order, x in enumerate((q, v, a)))
        return multipliers(self.condensation, self.data, self.times, q, v, a, lam)


def _map_and_select(spread: Any, x: Tensor, rows: list[int]) -> Tensor:
    """Rows of spread x, or of x where spread is None; x [times, k, pair, lanes]."""
    if spread is not None:
        y = spread.select_rows(rows)(x.transpose(0, 1).flatten(1, 2))
        return y.unflatten(1, (x.shape[0], x.shape[2])).transpose(0, 1)
    return select_rows(x, rows)


def select_rows(x: Tensor, rows: Sequence[int]) -> Tensor:
    """Rows of x [times, k, pair, lanes]."""
    return x.index_select(1, torch.tensor(rows, dtype=torch.long))
