"""Several arrays as one tensor, flattened and concatenated along one axis (array.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from torchmbd.extensions.native.codegen.array import Array, Traced, component_shape, new_variables, slice_bounds
from torchmbd.extensions.native.codegen.program import product, row_major
from torchmbd.extensions.native.codegen.size import (
    AnySize,
    Index,
    Size,
    Untraceable,
    Variable,
    constant_index,
    loop_index,
)


class Pieces(Traced):
    """Arrays concatenated along an axis, after the axes dim ... dim + n - 1 of each part (x, n) are flattened to one."""

    def __init__(self, dim: int, parts: Sequence[tuple[Array, int]]):
        self.axis, self.parts = dim, list(parts)
        self.program = self.parts[0][0].program
        self._array: Array | None = None

    def lengths(self) -> list[AnySize]:
        """Lengths of the parts along the axis."""
        return [product(x.shape[self.axis : self.axis + n]) for x, n in self.parts]

    @property
    def shape(self) -> tuple[AnySize, ...]:
        x, n = self.parts[0]
        total: AnySize = 0
        for length in self.lengths():
            total = total + length
        return (*x.shape[: self.axis], total, *x.shape[self.axis + n :])

    def each(self, f: Callable[[Array], Any]) -> Pieces:
        """The tensor with f applied to each part; f keeps the axes."""
        return Pieces(self.axis, [(f(x), n) for x, n in self.parts])

    def as_array(self) -> Array:
        """One array, stored in a buffer, with one loop along the axis."""
        if self._array is None:
            self._array = _joined_in_memory(self)
        return self._array

    def __getitem__(self, key: Any) -> Any:
        first = key[self.axis] if isinstance(key, tuple) and len(key) > self.axis else key
        before = key[: self.axis] if isinstance(key, tuple) else ()
        is_last = len(key) == self.axis + 1 if isinstance(key, tuple) else self.axis == 0
        if is_last and isinstance(first, slice) and all(k == slice(None) for k in before):
            parts = self._whole_parts(first)
            if parts is not None:
                return parts
        return self.as_array()[key]

    def _whole_parts(self, rows: slice) -> Pieces | None:
        """A slice that consists of whole parts; None if an end is inside of a part."""
        start, stop = slice_bounds(rows, self.shape[self.axis])
        ends: list[AnySize] = [0]
        for length in self.lengths():
            ends.append(ends[-1] + length)
        if start not in ends or stop not in ends:
            return None
        parts = self.parts[ends.index(start) : len(ends) - 1 - ends[::-1].index(stop)]
        return Pieces(self.axis, parts) if parts else None


def _joined_in_memory(pieces: Pieces) -> Array:
    program, dim = pieces.program, pieces.axis
    total = pieces.shape[dim]
    # All parts get the same variables along the other axes.
    first, merged = pieces.parts[0]
    others = first.shape[:dim] + first.shape[dim + merged :]
    loops = new_variables(others)
    extents = component_shape(others, loops)
    count = int(np.prod(extents, dtype=int))
    kept = sorted([v for v in loops if v is not None], key=program.rank)
    buffer = program.scratch(total * count * product(v.size for v in kept))
    start: AnySize = 0
    for x, n in pieces.parts:
        variables = new_variables((*others[:dim], *x.shape[dim : dim + n], *others[dim:]))
        x = x.with_loops([v if w is not None else None for v, w in zip(variables, x.loops, strict=True)])
        outer = [v for d, v in enumerate(variables) if v is not None and not dim <= d < dim + n]
        outer.sort(key=program.rank)
        inside = variables[dim : dim + n]
        for k in np.ndindex(*x.numbers.shape):
            along = constant_index(0)
            for i, size, v in zip(k[dim : dim + n], x.shape[dim : dim + n], inside, strict=True):
                along = along.times(size).plus(loop_index(v) if v is not None else i)
            component = int(np.ravel_multi_index(k[:dim] + k[dim + n :], extents)) if extents else 0
            index = _composed(along.plus(start), outer, total, count, component)
            program.write(buffer, [v for v in variables if v is not None], index, int(x.numbers[k]))
        start = start + product(x.shape[dim : dim + n])
    v = Variable(total, 0) if isinstance(total, Size) else None
    result_loops = (*loops[:dim], v, *loops[dim:])
    assert v is None or v not in loops
    if v is None:
        raise Untraceable("pieces of a number of components cannot be joined")
    numbers = np.empty([*extents[:dim], 1, *extents[dim:]], dtype=np.int64)
    for k in np.ndindex(*numbers.shape):
        component = int(np.ravel_multi_index(k[:dim] + k[dim + 1 :], extents)) if extents else 0
        numbers[k] = program._node("load", buffer.name, _composed(loop_index(v), kept, total, count, component))
    return Array(program, numbers, result_loops)


def _composed(along: Index, outer: Sequence[Variable], total: AnySize, count: int, component: int) -> Index:
    """Index in a buffer [outer..., along, component]."""
    return row_major(outer).times(total).plus(along).times(count).plus(component)
