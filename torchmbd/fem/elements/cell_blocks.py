"""The 6 x 6 blocks of a stiffness matrix between nodes that share a cell, and the sums of numbers of cells in its entries.

    K[6 R + i, 6 C + j] = sum over cells with the corners a = R, b = C of number entry_index[6 a + i, 6 b + j] of the cell

All follows from the pairs of nodes, which are 36 times fewer than the entries: only pairs are sorted.
Checked in tests/fem/elements/test_cell_blocks.py, tests/fem/elements/test_plate_matrices.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from torchmbd.math.linear_map import Sums
from torchmbd.math.sparse import Pattern

AT_ONCE = 2**17  # entries whose sums are found together


class CellBlocks:
    """The blocks of cells of several kinds, their corners [m, c], on so many nodes.

    pattern   of all entries
    """

    def __init__(self, corners: Sequence[Int[Tensor, "m c"]], nodes: int) -> None:
        pairs = torch.cat([(x[:, :, None] * nodes + x[:, None, :]).flatten() for x in corners])
        blocks, block = torch.unique(pairs, return_inverse=True)
        row, col = torch.div(blocks, nodes, rounding_mode="floor"), (blocks % nodes).to(torch.int32)
        self._first = _starts(torch.bincount(row, minlength=nodes))  # block of each row of blocks
        self._pairs = torch.argsort(block, stable=True)  # pairs by blocks
        self._start = _starts(torch.bincount(block))  # first pair of each block
        degree, six = self._first.diff(), torch.arange(6, dtype=torch.int32)
        start = _starts((6 * degree).repeat_interleave(6))
        # The columns of a row of blocks occur six times, one after another.
        count = degree.repeat_interleave(6)
        place = torch.arange(int(count.sum())) - (
            count.cumsum(0) - count - self._first[:-1].repeat_interleave(6)
        ).repeat_interleave(count)
        column = (6 * col[place][:, None] + six).flatten()
        self.pattern = Pattern.unchecked(start, column, 6 * nodes)

    def sums(
        self,
        first: Sequence[Int[Tensor, " m"]],
        entry_index: Sequence[Int[Tensor, "f f"]],
        size: int,
        entries: Int[Tensor, " k"] | None,
    ) -> Sums:
        """Return the map from numbers of cells [lanes, size] to entries of the pattern; None: to all of them.

        first        the first number of each cell, by kind
        entry_index  of each entry of its matrix, by kind
        """
        numbers, pairs, tables, offset = [], [], [], 0
        for of_cells, table in zip(first, entry_index, strict=True):
            c = len(table) // 6
            tables.append(table.reshape(c, 6, c, 6).movedim(2, 1).reshape(c * c, 36))
            numbers.append(of_cells.repeat_interleave(c * c))
            pairs.append(offset + torch.arange(c * c).repeat(len(of_cells)))
            offset += c * c
        number, pair, table = (torch.cat(x) for x in (numbers, pairs, tables))
        number, pair, row = number[self._pairs], pair[self._pairs], self.pattern.rows.to(torch.int32)
        chosen = torch.arange(self.pattern.nnz, dtype=torch.int32) if entries is None else entries
        counts, terms = [], []
        for entry in chosen.split(AT_ONCE):
            r = row[entry]
            R, i = torch.div(r, 6, rounding_mode="floor"), r % 6
            within = entry - self.pattern.start[r]
            block = self._first[R] + torch.div(within, 6, rounding_mode="floor")
            begin = self._start[block]
            count = self._start[block + 1] - begin
            ends = count.cumsum(0)
            term = torch.arange(int(count.sum())) + (begin - ends + count).repeat_interleave(count)
            index = 36 * pair[term] + (6 * i + within % 6).repeat_interleave(count)
            counts.append(count)
            terms.append((number[term] + table.flatten()[index]).to(torch.int32))
        return Sums(_starts(torch.cat(counts)), torch.cat(terms), size)


def _starts(counts: Tensor) -> Tensor:
    """Return the first place of each group, of `counts` [groups] places, and the end of the last [groups + 1]."""
    return torch.nn.functional.pad(counts.cumsum(0), (1, 0))
