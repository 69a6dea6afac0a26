"""Modes of a batch in which several lanes have the same matrices, as the scenarios of one design have: solved once.

Derivatives of lanes that share a factorization are more columns of one deflated solve.
Checked in tests/fem/reduction/test_shared_modes.py.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.cut import Modes


def shared_modes(K: Tensor, M: Tensor, solve: Callable[[Tensor, Tensor], Modes]) -> Modes:
    """Modes of K, M [lane, *entry], by `solve` of those lanes alone that differ in a number."""
    first, index = distinct(K, M)
    if len(first) == len(K):
        return solve(K, M)
    try:
        return SharedModes(solve(K[first], M[first]), index)
    except InputError:
        return solve(K, M)  # the error names a lane of all


def distinct(K: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
    """The first of all lanes with the same numbers [k], and for each lane which of these it equals [lane].

    Lanes of other numbers with the same sum, of which there are hardly any, count as lanes of their own.
    """
    lanes = torch.arange(len(K))
    sums, index = K.flatten(1).sum(1).unique(return_inverse=True)
    if len(sums) == len(K):
        return lanes, lanes
    first = torch.full_like(index, len(K)).scatter_reduce(0, index, lanes, "amin")[index]
    same = (K[first] == K).flatten(1).all(1) & (M[first] == M).flatten(1).all(1)
    return torch.where(same, first, lanes).unique(return_inverse=True)  # type: ignore[return-value]


class SharedModes(Modes):
    """`modes` of the lanes that differ; `index` [lane] tells which of them a lane is."""

    def __init__(self, modes: Modes, index: Tensor) -> None:
        self.modes, self.index = modes, index
        self.shift, self.counts = modes.shift[index], modes.counts[index]
        same = index[:, None] == index
        self._place = same.tril(-1).sum(1)  # among the lanes of the same matrices

    def lowest(self) -> tuple[Tensor, Tensor]:
        values, vectors = self.modes.lowest()
        return values[self.index], vectors[self.index]

    def deflated_solve(self, F: Tensor) -> Tensor:
        count = int(self._place.max()) + 1
        columns = F.new_zeros(len(self.modes.shift), count, *F.shape[1:])
        columns[self.index, self._place] = F
        Z = self.modes.deflated_solve(columns.movedim(1, 2).flatten(2, 3))
        return Z.unflatten(2, (count, -1)).movedim(2, 1)[self.index, self._place]
