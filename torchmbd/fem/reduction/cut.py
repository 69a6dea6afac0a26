"""The number of modes that a design retains, and the modes of a batch whose designs retain different numbers.

    gap_m = (lambda_m+1 - lambda_m) / lambda_m+1        behind the m lowest modes

A design retains n modes where gap_n is wider than NARROW. Elsewhere it retains n ... n + more modes: the number with the widest
gap behind it, the smallest of several. So no cluster of equal frequencies is cut, and derivatives divide by no small gap. The
number depends on the design alone, not on the other lanes of its batch. Neighboring designs retain different numbers only where
two gaps are equally wide or gap_n is NARROW; there responses change by the truncation, as little as the modes between the two
numbers contribute.

NARROW is 4 % of a frequency. Bending of a tube in two planes, or a torsional mode that passes it, is always nearer.
Checked in tests/fem/reduction/test_cut.py.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchmbd.errors import InputError, Path
from torchmbd.fem.reduction.dense import DenseModes
from torchmbd.fem.reduction.forms import lane_name
from torchmbd.fem.reduction.latest import Latest
from torchmbd.fem.reduction.sparse_modes import SparseModes
from torchmbd.fem.reduction.transport import DeflatedSolver, Pencil

NARROW = 0.08  # of an eigenvalue
ROUNDING = 16 * torch.finfo(torch.float64).eps  # error of an eigenvalue, relative to the largest K_ii / M_ii
SMALL = 150  # freedoms; up to this number all modes by a dense method cost no more


class CutCluster(InputError):
    """The number of modes cuts a cluster of eigenvalues.

    lanes   in which it does, leading dimensions flattened; the other lanes can be reduced
    beyond  the least larger number that does not cut the cluster, as far as eigenvalues are known
    """

    def __init__(
        self,
        path: Path,
        n: Any,
        allowed: str,
        hint: str,
        lanes: tuple[int, ...],
        beyond: int,
        shown: str,
        noun: str = "",
    ) -> None:
        super().__init__(path, n, allowed, hint, noun=noun, shown=shown)
        self.lanes, self.beyond = lanes, beyond

    def of_body(self, name: str) -> CutCluster:
        """The error for the modes of a body."""
        path, noun = (name, "modes"), f"{name!r}: modes"
        return CutCluster(path, self.value, str(self.allowed), self.hint, self.lanes, self.beyond, self._shown, noun)


class Modes(DeflatedSolver, Protocol):
    """The lowest modes of a batch.

    counts   number of modes that each lane retains [lane]
    """

    shift: Tensor
    counts: Tensor

    def lowest(self) -> tuple[Tensor, Tensor]:
        """Eigenvalues [lane, more than n] and vectors [lane, N, n], n the largest count; vectors beyond a count are zero."""
        ...


_latest: Latest[Modes] = Latest()


def rounding(pencil: Pencil, K: Tensor, M: Tensor) -> Tensor:
    """Return the error of eigenvalues by rounding of K and M [...]."""
    return ROUNDING * (pencil.K_form.diagonal(K).abs() / pencil.M_form.diagonal(M)).amax(-1)


def cut_modes(pencil: Pencil, n: int, more: int, cluster: float, K: Tensor, M: Tensor) -> Modes:
    """Return the modes of K, M [lane, *entry], cut as the module header says; count 0 where every cut divides a cluster."""
    key = pencil.K_form, pencil.M_form, n, more, cluster
    return _latest(key, (K, M), partial(_cut_modes, pencil, n, more, cluster, K, M))


def _cut_modes(pencil: Pencil, n: int, more: int, cluster: float, K: Tensor, M: Tensor) -> Modes:
    size = pencil.K_form.size
    modes, most = _solved(pencil, n, K, M), min(n + more, size)
    gaps = _Gaps.of(pencil, modes, cluster, K, M)
    if more == 0 or modes.complete:
        modes.retain(gaps.counts(n, most, size)[0])
        return modes
    near = ~gaps.apart[:, n - 1] | (
        gaps.relative[:, n - 1] <= NARROW
    )  # further eigenvalues are rough: solve for more modes
    if not near.any():
        return modes
    K, M, solved = K[near], M[near], most
    fewer = modes if near.all() else None
    while True:
        fewer = wide = _solved(pencil, solved, K, M, fewer)
        counts, unknown = _Gaps.of(pencil, wide, cluster, K, M).counts(n, most, solved)
        if not unknown.any():
            break
        solved = min(2 * solved, size)
    wide.retain(counts)
    return wide if near.all() else PartModes(modes, near, wide)


def cut_error(pencil: Pencil, modes: Modes, n: int, more: int, cluster: float, K: Tensor, M: Tensor) -> CutCluster:
    """The error for the lanes of count 0."""
    lanes = (modes.counts == 0).nonzero().squeeze(-1).tolist()
    lane, others, size = lanes[0], ", ".join(map(str, lanes[1:])), pencil.K_form.size
    where = lane_name(lane, len(modes.counts)) + (f" (and of lanes {others})" if others else "")
    one, known = slice(lane, lane + 1), min(n + more, size)

    def ends(known: int) -> list[int]:
        """Numbers of modes behind which there is a gap."""
        gaps = _Gaps.of(pencil, _solved(pencil, known, K[one], M[one]), cluster, K[one], M[one])
        return (gaps.apart[0].nonzero()[:, 0] + 1).tolist()

    if not more:
        values = modes.lowest()[0][lane]
        known_ends = ends(known)
        below, beyond = max((e for e in known_ends if e < n), default=0), next((e for e in known_ends if e > n), 0)
        allowed = (
            f"must not cut a cluster, as eigenvalues {n} and {n + 1} are {values[n - 1]:.10g} and {values[n]:.10g}, closer "
            f"than cluster = {cluster:g} relative"
        )
        hint = " or ".join(f"n = {end}" for end in (below, beyond) if end) or "more modes"
        return CutCluster(("n",), n, allowed, hint, tuple(lanes), beyond or len(values), f"{n}{where}")
    while not (further := [end for end in ends(known) if end > n]):
        known = min(2 * known, size)
    beyond = further[0]
    allowed = f"must not divide modes of equal frequency, as modes {n} to {beyond} are"
    return CutCluster(("modes",), n, allowed, f"modes = {beyond}", tuple(lanes), beyond, f"{n}{where}")


def _solved(
    pencil: Pencil, n: int, K: Tensor, M: Tensor, fewer: DenseModes | SparseModes | None = None
) -> DenseModes | SparseModes:
    """The n lowest modes, and the eigenvalue of one more if there is one; `fewer` modes of K, M are continued."""
    if pencil.K_form.size > max(SMALL, 12 * n):
        if isinstance(fewer, SparseModes):
            modes = fewer
            modes.more(n)
        else:
            modes = SparseModes(pencil.K_form, pencil.M_form, K, M, n)
        if not modes.exhausted:
            return modes
    return DenseModes(pencil.K_form, pencil.M_form, K, M, n)


class _Gaps(NamedTuple):
    """The gaps behind modes [lane, modes].

    relative   as in the module header; behind the last of all modes NARROW
    apart      which are wider than a cluster and than rounding
    cluster    largest relative gap in a cluster
    """

    relative: Tensor
    apart: Tensor
    cluster: float

    @classmethod
    def of(cls, pencil: Pencil, modes: DenseModes | SparseModes, cluster: float, K: Tensor, M: Tensor) -> _Gaps:
        values = modes.eigenvalues()
        gaps, above = values.diff(dim=1), values[:, 1:].abs()
        accuracy = rounding(pencil, K, M).maximum(ROUNDING * modes.shift.abs())[:, None]
        apart = gaps > torch.maximum(cluster * above, accuracy)
        relative = torch.where(gaps > 0.0, gaps / above, 0.0)
        if modes.complete:
            pad = torch.nn.functional.pad
            relative, apart = pad(relative, (0, 1), value=NARROW), pad(apart, (0, 1), value=True)
        return cls(relative, apart, cluster)

    def counts(self, n: int, most: int, known: int) -> tuple[Tensor, Tensor]:
        """The numbers of modes [lane], 0 where all up to `most` divide a cluster; and where gaps beyond those known are needed.

        Frequencies whose differences are lost in the rounding of the highest are retained together, however many they are.
        """
        gaps = torch.where(self.apart, self.relative, 0.0)[:, n - 1 : most]
        further = torch.where(gaps[:, 0] > NARROW, 0, gaps.argmax(1))
        counts = torch.where(gaps.gather(1, further[:, None])[:, 0] > 0.0, n + further, 0)
        lost = (counts == 0) & (self.relative[:, n - 1 : most] > self.cluster).any(1)
        if most == n or not lost.any():
            return counts, torch.zeros_like(lost)
        beyond = torch.nn.functional.pad(self.apart[:, most:known], (0, 1))
        return torch.where(lost & beyond.any(1), most + 1 + beyond.int().argmax(1), counts), lost & ~beyond.any(1)


class PartModes(Modes):
    """`modes` of a batch, with others in the lanes of a mask `near` [lane]: those of `wide`."""

    def __init__(self, modes: Modes, near: Tensor, wide: Modes) -> None:
        self.modes, self.near, self.wide = modes, near, wide
        self.shift, self.counts = modes.shift.clone(), modes.counts.clone()
        self.shift[near], self.counts[near] = wide.shift, wide.counts

    def lowest(self) -> tuple[Tensor, Tensor]:
        of_modes, of_wide = self.modes.lowest(), self.wide.lowest()
        sizes = [max(x.shape[-1], y.shape[-1]) for x, y in zip(of_modes, of_wide, strict=True)]
        values, vectors = (widened(x, size) for x, size in zip(of_modes, sizes, strict=True))
        values[self.near], vectors[self.near] = (widened(x, size) for x, size in zip(of_wide, sizes, strict=True))
        return values, vectors

    def deflated_solve(self, F: Tensor) -> Tensor:
        n = int(self.modes.counts.max())
        of_others = F[..., :n].clone()
        of_others[self.near] = 0.0  # their modes are too near for it
        Z = widened(self.modes.deflated_solve(of_others), F.shape[3])
        m = int(self.wide.counts.max())
        Z[self.near, ..., :m] = self.wide.deflated_solve(F[self.near][..., :m])
        return Z


def widened(x: Tensor, size: int) -> Tensor:
    """A copy of x [..., n] with zeros up to [..., size]."""
    return torch.nn.functional.pad(x, (0, size - x.shape[-1])).clone()
