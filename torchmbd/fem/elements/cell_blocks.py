"""The 6 x 6 blocks of a stiffness matrix between nodes that share a cell, and the sums of numbers of cells in its entries.

    K[6 R + i, 6 C + j] = sum over cells with the corners a = R, b = C of number entry_index[6 a + i, 6 b + j] of the cell

All follows from the pairs of nodes, which are 36 times fewer than the entries: only pairs are sorted.
Checked in tests/fem/elements/test_plate_matrices.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Int
from scipy.sparse import bsr_array
from torch import Tensor

from torchmbd.math.linear_map import Sums
from torchmbd.math.sparse import Pattern

AT_ONCE = 2**20  # entries whose sums are found together


class CellBlocks:
    """The blocks of cells of several kinds, their corners [m, c], on so many nodes.

    pattern   of all entries
    """

    def __init__(self, corners: Sequence[Int[Tensor, "m c"]], nodes: int) -> None:
        pairs = np.concatenate([(x[:, :, None] * nodes + x[:, None, :]).flatten().numpy() for x in corners])
        blocks, block = np.unique(pairs, return_inverse=True)
        row, col = np.divmod(blocks, nodes)
        self._first = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=nodes))])  # block of each row of blocks
        self._pairs = np.argsort(block, kind="stable")  # pairs by blocks
        self._start = np.concatenate([[0], np.cumsum(np.bincount(block))])  # first pair of each block
        numbers = np.ones((len(blocks), 6, 6), dtype=np.int8)
        full = bsr_array((numbers, col, self._first), shape=(6 * nodes, 6 * nodes)).tocsr()
        self.pattern = Pattern.unchecked(full.indptr, full.indices, 6 * nodes)

    def sums(
        self,
        first: Sequence[Int[Tensor, " m"]],
        entry_index: Sequence[Int[Tensor, "f f"]],
        size: int,
        entries: Tensor | None,
    ) -> Sums:
        """Return the map from numbers of cells [lanes, size] to entries of the pattern; None: to all of them.

        first        the first number of each cell, by kind
        entry_index  of each entry of its matrix, by kind
        """
        starts, tables, offset = [], [], 0
        for numbers, table in zip(first, entry_index, strict=True):
            c = len(table) // 6
            by_pair = table.reshape(c, 6, c, 6).movedim(2, 1).reshape(c * c, 36)
            starts.append(
                np.stack([numbers.repeat_interleave(c * c), offset + torch.arange(c * c).repeat(len(numbers))])
            )
            tables.append(by_pair.numpy().astype(np.int32))
            offset += c * c
        number, pair = np.concatenate(starts, 1)[:, self._pairs]
        table, row = np.concatenate(tables), self.pattern.rows.numpy().astype(np.int32)
        chosen = np.arange(self.pattern.nnz, dtype=np.int32) if entries is None else entries.numpy()
        counts, terms = [], []
        for k in range(0, len(chosen), AT_ONCE):
            entry = chosen[k : k + AT_ONCE]
            r = row[entry]
            R, i = np.divmod(r, 6)
            place, j = np.divmod(entry - self.pattern.indptr[r], 6)
            block = self._first[R] + place
            begin = self._start[block]
            count = self._start[block + 1] - begin
            counts.append(count)
            ends = np.cumsum(count)
            term = np.arange(ends[-1]) + np.repeat(begin - ends + count, count)
            terms.append((number[term] + table[pair[term], np.repeat(6 * i + j, count)]).astype(np.int32))
        start = np.cumsum(np.concatenate([np.zeros(1, np.int64), *counts]))
        return Sums(torch.from_numpy(start), torch.from_numpy(np.concatenate([np.zeros(0, np.int32), *terms])), size)
