"""Coordinates and multipliers of the whole system from those of its condensed system (condensation.py).

    retained bodies                rows of the condensed system; rates by the constant map `Topology.spread`
    prescribed bodies              their known motions, which have no design tangents
    multipliers of removed rows    reactions.py

Rows are computed on demand, as most of a motion is never read.
Checked in tests/multibody/saddle/test_condensation.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchmbd.math.module_call import outside_transforms
from torchmbd.math.row_selection import select_rows
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.index_maps import SparseMap
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

    def at_end(self) -> Expansion:
        """The expansion at the last time alone."""
        last = [(number, tuple(x[-1:] for x in motion)) for number, motion in self.prescribed]
        return replace(self, times=self.times[-1:], prescribed=last)

    def rows(self, order: int, x: Tensor, index: Sequence[int] | None = None, values: bool = True) -> Tensor:
        """Rows of q (order 0), v (1) or a (2) [times, k, pair, lanes] of the whole system, from x of the condensed one.

        index    rows of the whole system, from its end if negative, as for a tensor; None: all
        values   whether the first entry of the pair axis is a value, and the others tangents; False: all are tangents
        """
        c, components = self.condensation, 6 if order else 7
        selected = _selected(c, components, None if index is None else tuple(index))
        y = select_rows(x, selected.source) if selected.map is None else selected.map(x, 1)
        if len(selected.places) == selected.count:
            return y
        result = y.new_zeros(len(x), selected.count, *x.shape[2:])
        result[:, selected.places] = y
        for number, motion in self.prescribed if values else ():
            places, components = selected.of_body[number]
            result[:, places, 0] = motion[order][:, components, None]
        return result

    def multipliers(self, q: Tensor, v: Tensor, a: Tensor, lam: Tensor) -> Tensor:
        """All multipliers [times, rows, pair, lanes], from q, v, a and lam of the condensed system."""
        q, v, a = (self.rows(order, x) for order, x in enumerate((q, v, a)))
        return multipliers(self.condensation, self.data, self.times, q, v, a, lam)


class _Selected(NamedTuple):
    """Rows of the whole system, out of those of the condensed one.

    count         how many they are
    places        those that follow from the rows `source` of retained bodies, by a `map` or as they are
    of_body       number of a prescribed body -> those that it has, and their components
    """

    count: int
    places: Tensor
    source: Tensor
    map: SparseMap | None
    of_body: dict[int, tuple[Tensor, Tensor]]


#: The rows of each condensation: all, and those of each body and order. They hold no body, which would live as long as they.
_SELECTED: WeakKeyDictionary[Condensation, dict[tuple[int, tuple[int, ...] | None], _Selected]] = WeakKeyDictionary()


def _selected(c: Condensation, components: int, index: tuple[int, ...] | None) -> _Selected:
    """The rows of `index` (None: all) of q (7 components for each body) or of v and a (6)."""
    known, key = _SELECTED.setdefault(c, {}), (components, index)
    if key not in known:
        with torch.inference_mode(False):  # kept for any mode of later callers
            known[key] = outside_transforms(lambda: _made(c, components, index))
    return known[key]


def _made(c: Condensation, components: int, index: tuple[int, ...] | None) -> _Selected:
    position = {row: i for i, row in enumerate(component_rows(c.whole, c.bodies, components).tolist())}
    every = range(component_count(c.whole, components))
    rows = [every[row] for row in (every if index is None else index)]
    places = [i for i, row in enumerate(rows) if row in position]
    source = [position[rows[i]] for i in places]
    of_body, n = {}, c.whole.bodies
    for body in (c.whole.names.index(body.name) for body in c.topology.prescribed_bodies):
        places_of_body = [i for i, row in enumerate(rows) if row < components * n and row % n == body]
        of_body[body] = _indices(places_of_body), _indices([rows[i] // n for i in places_of_body])
    spread = c.topology.spread if components == 6 else None
    return _Selected(len(rows), _indices(places), _indices(source), spread and spread.select_rows(source), of_body)


def _indices(numbers: Sequence[int]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.long)
