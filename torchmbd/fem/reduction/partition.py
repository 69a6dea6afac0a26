"""Block-tridiagonal partition of a sparse pattern: an order of its rows, and the first row of each block.

After reordering, rows of block i are coupled with those of blocks i - 1, i and i + 1 only. A plate numbered along its
long side has one block for each line of nodes, without padding. Blocks make factorizations fast: small dense products over
all designs and all right-hand sides at once. Computed once per pair of patterns (of K and M) and cached.
Checked in tests/fem/reduction/test_sparse_modes.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from torch import Tensor

from torchmbd.fem.reduction.forms import Dense, Form, Sparse
from torchmbd.math.linear_map import Sums
from torchmbd.math.sparse import Pattern

SMALLEST_BLOCK = 24  # smaller ones cost more in calls than they save in arithmetic
TRIALS = 256  # sizes of the first block; more differ by less than 1 % in cost


@dataclass(frozen=True, eq=False)
class Partition:
    """The order (new row -> old row, and back) and the first row of each block, with the end appended."""

    order: Tensor
    inverse: Tensor
    bounds: tuple[int, ...]

    @property
    def sizes(self) -> list[int]:
        return [end - start for start, end in zip(self.bounds, self.bounds[1:], strict=False)]

    def positions(self, rows: Tensor, cols: Tensor) -> tuple[Tensor, Tensor, int]:
        """Where entries go in the storage D_0, D_1, ..., B_1, B_2, ... of diagonal and lower blocks, row by row.

        Returns the entries that are stored (those of lower blocks), their positions, and the length of the storage.
        """
        bounds = torch.tensor(self.bounds)
        size = bounds.diff()
        start_D = torch.cat([torch.zeros(1, dtype=torch.long), (size * size).cumsum(0)])
        start_B = start_D[-1] + torch.cat([torch.zeros(1, dtype=torch.long), (size[1:] * size[:-1]).cumsum(0)])
        r, c = self.inverse[rows], self.inverse[cols]
        block_r, block_c = (torch.searchsorted(bounds, x, right=True) - 1 for x in (r, c))
        stored = (block_r >= block_c).nonzero().squeeze(-1)
        r, c, block_r, block_c = (x[stored] for x in (r, c, block_r, block_c))
        start = torch.where(block_r == block_c, start_D[block_r], start_B[(block_r - 1).clamp_min(0)])
        return stored, start + (r - bounds[block_r]) * size[block_c] + c - bounds[block_c], int(start_B[-1])


def partition(K_form: Form, M_form: Form) -> Partition:
    """Choose the cheaper of the given numbering and reverse Cuthill-McKee; a dense matrix is one block."""
    if isinstance(K_form, Dense) or isinstance(M_form, Dense):
        everything = torch.arange(K_form.size)
        return Partition(everything, everything, (0, K_form.size))
    patterns = [form.pattern for form in (K_form, M_form) if isinstance(form, Sparse)]
    if not patterns:
        patterns = [Pattern(torch.arange(K_form.size), torch.arange(K_form.size), K_form.size)]
    return _of_patterns(tuple(patterns))


@lru_cache(maxsize=64)
def _of_patterns(patterns: tuple[Pattern, ...]) -> Partition:
    size = patterns[0].size
    graph = sum((_graph(p) for p in patterns[1:]), _graph(patterns[0]))
    candidates = []
    for order in (np.arange(size), reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)):
        inverse = np.empty(size, dtype=np.int64)
        inverse[order] = np.arange(size)
        reach = np.arange(size)  # of each row: the last one with which it is coupled
        for pattern in patterns:
            _reach(pattern, inverse, reach)
        bounds = _cut(reach, size)
        candidates.append((_cost(bounds), order, inverse, bounds))
    _, order, inverse, bounds = min(candidates, key=lambda candidate: candidate[0])
    return Partition(torch.from_numpy(order), torch.from_numpy(inverse), tuple(bounds))


def _cost(bounds: list[int]) -> float:
    """Arithmetic of one solve, and the overhead of the calls for each block in the same unit."""
    sizes = np.diff(bounds)
    return float((sizes**2 + SMALLEST_BLOCK**2).sum())


def _graph(pattern: Pattern) -> csr_array:
    shape = (pattern.size, pattern.size)
    return csr_array((np.ones(pattern.nnz, dtype=np.int8), pattern.indices, pattern.indptr), shape=shape)


def _reach(pattern: Pattern, inverse: np.ndarray, reach: np.ndarray) -> None:
    """Raise the entries of `reach`, by new rows, to the columns of a pattern."""
    full = np.diff(pattern.indptr).nonzero()[0]  # rows with entries
    last = np.maximum.reduceat(inverse[pattern.indices], pattern.indptr[full])
    reach[inverse[full]] = np.maximum(reach[inverse[full]], last)


def _cut(reach: np.ndarray, size: int) -> list[int]:
    """Return the cheapest bounds for this order: each block ends at the last row with which the block before is coupled."""
    reach = np.maximum.accumulate(reach) + 1
    widest = min(size, 2 * int((reach - np.arange(size)).max()))
    end = np.arange(1, widest + 1, max(widest // TRIALS, 1))  # of the block at hand, for each size of the first block
    cost, ends = (end**2 + SMALLEST_BLOCK**2).astype(float), [end]
    while (end < size).any():
        following = np.where(end < size, np.maximum(reach[end - 1], np.minimum(end + SMALLEST_BLOCK, size)), size)
        cost += np.where(end < size, (following - end) ** 2.0 + SMALLEST_BLOCK**2, 0.0)
        end = following
        ends.append(end)
    best = [0, *dict.fromkeys(int(x[cost.argmin()]) for x in ends)]
    return min(best, [0, size], key=_cost)


@lru_cache(maxsize=64)
def form_sums(layout: Partition, form: Form) -> Sums:
    """Return the map from the values of a form, flattened, to block storage (`Partition.positions`)."""
    if isinstance(form, Sparse):
        rows, cols = form.pattern.rows, form.pattern.cols
    else:
        every = torch.arange(form.size)
        dense = isinstance(form, Dense)
        rows, cols = (every.repeat_interleave(form.size), every.repeat(form.size)) if dense else (every, every)
    stored, positions, length = layout.positions(rows, cols)
    return Sums.of(positions, stored, (length, len(rows)))
