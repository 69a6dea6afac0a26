"""Sums of segments as `SegmentSum` (multibody/equations/index_maps.py), with a table that is known at run time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchmbd.extensions.native.codegen.array import Array, Table, component_shape, new_variables, zeros
from torchmbd.extensions.native.codegen.pieces import Pieces
from torchmbd.extensions.native.codegen.program import product, row_major
from torchmbd.extensions.native.codegen.size import AnySize, Index, loop_index
from torchmbd.math.pair import Pair, value


class SymbolicSegmentSum:
    """Sums of the columns of concatenated arrays [k, n, ...] in groups [k, groups, ...]; `table` has the group of each column.

    Columns of group number `groups` are left out. k may be flattened.
    """

    def __init__(self, table: Table, groups: AnySize):
        self.table, self.groups = table, groups

    def __call__(self, *parts: Any) -> Any:
        first = parts[0]
        if any(isinstance(x, Pair) for x in parts):
            tangents = [x.tangent if isinstance(x, Pair) else zeros(x.program, x.shape) for x in parts]
            return Pair.of(self(*(value(x) for x in parts)), self(*tangents))
        if isinstance(first, Pieces) and first.axis == 0 and len(parts) == len(first.parts) == 1:
            ((x, n),) = first.parts
            return Pieces(0, [(self._along([x], n), n)])
        return self._along([x.as_array() for x in parts], 1)

    def _along(self, arrays: Sequence[Array], axis: int) -> Array:
        """The sums of columns along an axis."""
        program, first = arrays[0].program, arrays[0]
        others = first.shape[:axis] + first.shape[axis + 1 :]
        if self.groups == 0:
            return zeros(program, (*others[:axis], 0, *others[axis:]))
        loops = new_variables(others)
        extents = component_shape(others, loops)
        count = int(np.prod(extents, dtype=int))
        kept = sorted([v for v in loops if v is not None], key=program.rank)
        each = count * product(v.size for v in kept)
        buffer = program.scratch((self.groups + 1) * each)

        def where(group: Index, k: tuple[int, ...]) -> Index:
            component = int(np.ravel_multi_index(k, extents)) if extents else 0
            return group.times(each).plus(row_major(kept).times(count)).plus(component)

        start: AnySize = 0
        for x in arrays:
            (v,) = new_variables((x.shape[axis],))
            assert v is not None
            assert v not in loops
            x = x.with_loops((*loops[:axis], v, *loops[axis:]))
            group = self.table.lookup(loop_index(v).plus(start))
            for k in np.ndindex(*x.numbers.shape):
                index = where(group, k[:axis] + k[axis + 1 :])
                program.write(buffer, [v, *kept], index, int(x.numbers[k]), adds=True)
            start = start + v.size
        (out,) = new_variables((self.groups,))
        assert out is not None
        numbers = np.empty((*extents[:axis], 1, *extents[axis:]), dtype=np.int64)
        for k in np.ndindex(*numbers.shape):
            index = where(loop_index(out), k[:axis] + k[axis + 1 :])
            numbers[k] = program._node("load", buffer.name, index) if buffer.writes else program.zero
        return Array(program, numbers, (*loops[:axis], out, *loops[axis:]))
