"""Modes of a batch: lanes with the same matrices, as the scenarios of one design have, are solved once; groups run on threads.

Derivatives of lanes that share a factorization are more columns of one deflated solve.
A batch is solved in groups of lanes (math/threads.py), which need less memory at a time and which threads share.
Checked in tests/fem/reduction/test_shared_modes.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.cut import Modes, widened
from torchmbd.fem.reduction.transport import DeflatedSolver, Pencil
from torchmbd.math.threads import lane_groups, map_threads

_ROUNDING = 64 * torch.finfo(torch.float64).eps  # share of the largest number: of sums of elements


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
    """The first of all lanes with the same numbers but for rounding [k], and for each lane which of these it equals [lane].

    Processors compute the last lanes of an array in another way than the others, so that lanes of one design may differ in
    their last digits. Lanes of other numbers with the same sum, of which there are hardly any, count as lanes of their own.
    """
    lanes = torch.arange(len(K))
    if len(K) == 1:
        return lanes, lanes
    sums, order = K.flatten(1).sum(1).sort(stable=True)
    far = (sums.diff() > _ROUNDING * K.abs().sum() / len(K)).long()
    if bool(far.all()):
        return lanes, lanes
    index = torch.empty_like(order).index_copy(0, order, torch.nn.functional.pad(far, (1, 0)).cumsum(0))
    first = torch.full_like(index, len(K)).scatter_reduce(0, index, lanes, "amin")[index]
    same = _are_equal(K, K[first]) & _are_equal(M, M[first])
    return torch.where(same, first, lanes).unique(return_inverse=True)  # type: ignore[return-value]


def _are_equal(x: Tensor, y: Tensor) -> Tensor:
    """True for lanes that differ by rounding at most [lane]."""
    return ((x - y).abs() <= _ROUNDING * x.abs().amax()).flatten(1).all(1)


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
        return self._joined(values), self._joined(vectors)

    def deflated_solve(self, F: Tensor) -> Tensor:
        F = F.detach()
        return self._joined(
            map_threads(lambda group, modes: _Padded(modes).deflated_solve(F[group]), self.groups, self.modes)
        )

    def derivative(self, rule: Callable[..., tuple[Tensor, Tensor]], pencil: Pencil, *tensors: Tensor | None) -> Any:
        """Return the two tensors [lane, ...] of a rule of transport.py, which each group applies to its lanes."""
        plain = [None if x is None else x.detach() for x in tensors]

        def apply(group: slice, modes: Modes) -> tuple[Tensor, Tensor]:
            part = Pencil(pencil.K_form, pencil.M_form)
            part.modes = _Padded(modes)
            return rule(part, *(None if x is None else x[group] for x in plain))

        return tuple(map(self._joined, zip(*map_threads(apply, self.groups, self.modes), strict=True)))

    def _joined(self, parts: Sequence[Tensor]) -> Tensor:
        """Tensors [lane, ..., n] of groups as one, with zeros up to the largest n."""
        size = max(x.shape[-1] for x in parts)
        result = parts[0].new_empty(self.groups[-1].stop, *parts[0].shape[1:-1], size)

        def write(group: slice, part: Tensor) -> None:
            result[group, ..., : part.shape[-1]] = part
            result[group, ..., part.shape[-1] :] = 0.0

        map_threads(write, self.groups, parts)
        return result


class _Padded(DeflatedSolver):
    """Modes of a group that may retain fewer modes than others: their solutions have further columns of zeros."""

    def __init__(self, modes: Modes) -> None:
        self.modes = modes

    def deflated_solve(self, F: Tensor) -> Tensor:
        count = int(self.modes.counts.max())
        Z = self.modes.deflated_solve(F[..., :count])
        return Z if count == F.shape[-1] else widened(Z, F.shape[-1])


def apply_rule(rule: Callable[..., tuple[Tensor, Tensor]], pencil: Pencil, *tensors: Tensor | None) -> Any:
    """Return rule(pencil, *tensors) of tensors [lane, ...]; groups of lanes apply it on threads."""
    if isinstance(pencil.modes, GroupedModes):
        return pencil.modes.derivative(rule, pencil, *tensors)
    return rule(pencil, *tensors)


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
