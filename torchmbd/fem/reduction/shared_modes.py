"""Modes of a batch: lanes with the same matrices, as the scenarios of one design have, are solved once; groups run on threads.

Derivatives of lanes that share a factorization are more columns of one deflated solve.
A batch is solved in groups of lanes (math/threads.py), which need less memory at a time and which threads share.
Checked in tests/fem/reduction/test_shared_modes.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.cut import Modes, widened
from torchmbd.math.threads import lane_groups, map_threads


def shared_modes(K: Tensor, M: Tensor, solve: Callable[[Tensor, Tensor], Modes]) -> Modes:
    """Modes of K, M [lane, *entry], by `solve` of those lanes alone that differ in a number."""
    first, index = distinct(K, M)
    try:
        if len(first) == len(K):
            return _grouped(K, M, solve)
        return SharedModes(_grouped(K[first], M[first], solve), index)
    except InputError:
        return solve(K, M)  # the error names a lane of all


def _grouped(K: Tensor, M: Tensor, solve: Callable[[Tensor, Tensor], Modes]) -> Modes:
    groups = lane_groups(len(K))
    return GroupedModes(K, M, groups, solve) if len(groups) > 1 else solve(K, M)


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


class GroupedModes(Modes):
    """Modes of a batch, solved for each of its groups."""

    def __init__(self, K: Tensor, M: Tensor, groups: list[slice], solve: Callable[[Tensor, Tensor], Modes]) -> None:
        K, M = K.detach(), M.detach()  # without tangents, which other threads would propagate
        self.groups = groups
        self.modes = map_threads(lambda group: solve(K[group], M[group]), groups)
        self.shift, self.counts = (
            torch.cat([getattr(modes, name) for modes in self.modes]) for name in ("shift", "counts")
        )

    def lowest(self) -> tuple[Tensor, Tensor]:
        values, vectors = zip(*map_threads(lambda modes: modes.lowest(), self.modes), strict=True)
        return _joined(values), _joined(vectors)

    def deflated_solve(self, F: Tensor) -> Tensor:
        F, Z = F.detach(), torch.empty_like(F)

        def write(group: slice, modes: Modes) -> None:
            count = int(modes.counts.max())  # the columns of further modes are zero
            Z[group, ..., count:] = 0.0
            Z[group, ..., :count] = modes.deflated_solve(F[group, ..., :count])

        map_threads(write, self.groups, self.modes)
        return Z


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Tensors [lane, ..., n] of groups as one, with zeros up to the largest n."""
    size = max(x.shape[-1] for x in parts)
    return torch.cat([x if x.shape[-1] == size else widened(x, size) for x in parts])


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
