"""The number of modes that a design retains, and the modes of a batch whose designs retain different numbers.

    gap_m = (lambda_m+1 - lambda_m) / lambda_m+1        behind the m lowest modes

A design retains n modes where gap_n is wider than NARROW. Elsewhere it retains n ... n + more modes: the number with the widest
gap behind it, the smallest of several. So no cluster of equal frequencies is cut, and derivatives divide by no small gap. The
number depends on the design alone, not on the other lanes of its batch. Neighboring designs retain different numbers only where
two gaps are equally wide or gap_n is NARROW; there responses change by the truncation, as little as the modes between the two
numbers contribute.

NARROW is 5 % of a frequency. Bending of a tube in two planes, or a torsional mode that passes it, is always nearer.
Checked in tests/fem/reduction/test_cut.py.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.dense import DenseModes
from torchmbd.fem.reduction.forms import lane_name
from torchmbd.fem.reduction.sparse_modes import SparseModes
from torchmbd.fem.reduction.transport import DeflatedSolver, Pencil

NARROW = 0.1  # of an eigenvalue
ROUNDING = 16 * torch.finfo(torch.float64).eps  # error of an eigenvalue, relative to the largest K_ii / M_ii
SMALL = 150  # freedoms; up to this number all modes by a dense method cost no more


class CutCluster(InputError):
    """The number of modes cuts a cluster of eigenvalues.

    lanes   in which it does, leading dimensions flattened; the other lanes can be reduced
    beyond  the least larger number that does not cut the cluster, as far as eigenvalues are known
    """

    def __init__(self, message: str, lanes: tuple[int, ...], beyond: int) -> None:
        super().__init__(message)
        self.lanes, self.beyond = lanes, beyond


class Modes(DeflatedSolver, Protocol):
    """The lowest modes of a batch.

    counts   number of modes that each lane retains [lane]
    """

    shift: Tensor
    counts: Tensor

    def lowest(self) -> tuple[Tensor, Tensor]:
        """Eigenvalues [lane, more than n] and vectors [lane, N, n], n the largest count; vectors beyond a count are zero."""
        ...


def rounding(pencil: Pencil, K: Tensor, M: Tensor) -> Tensor:
    """Return the error of eigenvalues by rounding of K and M [...]."""
    return ROUNDING * (pencil.K_form.diagonal(K).abs() / pencil.M_form.diagonal(M)).amax(-1)


def cut_modes(pencil: Pencil, n: int, more: int, cluster: float, K: Tensor, M: Tensor) -> Modes:
    """Return the modes of K, M [lane, *entry], cut as the module header says; count 0 where every cut divides a cluster."""
    accuracy, most = rounding(pencil, K, M), min(n + more, pencil.K_form.size)
    modes = _solved(pencil, n, K, M)
    gaps = _gaps(modes, accuracy, cluster)
    if more == 0 or modes.complete:
        modes.retain(_counts(gaps, n, most))
        return modes
    near = gaps[:, n - 1] <= NARROW  # further eigenvalues of a sparse problem are rough: more modes are solved for
    if not near.any():
        return modes
    wide = _solved(pencil, most, K[near], M[near])
    wide.retain(_counts(_gaps(wide, accuracy[near], cluster), n, most))
    return wide if near.all() else PartModes(modes, near, wide)


def cut_error(pencil: Pencil, modes: Modes, n: int, more: int, cluster: float, K: Tensor, M: Tensor) -> CutCluster:
    """The error for the lanes of count 0."""
    lanes = (modes.counts == 0).nonzero().squeeze(-1).tolist()
    lane, others = lanes[0], ", ".join(map(str, lanes[1:]))
    where = lane_name(lane, len(modes.counts)) + (f" (and of lanes {others})" if others else "")
    one = slice(lane, lane + 1)
    K, M = K[one], M[one]
    accuracy, known = rounding(pencil, K, M), min(n + more, pencil.K_form.size)
    solved = _solved(pencil, known, K, M)
    ends = _ends(solved, accuracy, cluster)
    if not more:
        values = solved.eigenvalues()[0]
        below, beyond = max((e for e in ends if e < n), default=0), next((e for e in ends if e > n), 0)
        allowed = [f"n = {end}" for end in (below, beyond) if end]
        text = (
            f"n = {n} cuts a cluster{where}: eigenvalues {n} and {n + 1} are {values[n - 1]:.10g} and {values[n]:.10g}, closer "
            f"than cluster = {cluster:g} relative; take {' or '.join(allowed) or 'more modes'}"
        )
        return CutCluster(text, tuple(lanes), beyond or len(values))
    while not any(end > n for end in ends):
        known = min(2 * known, pencil.K_form.size)
        ends = _ends(_solved(pencil, known, K, M), accuracy, cluster)
    beyond = min(end for end in ends if end > n)
    text = f"modes = {n}{where}: must not divide modes of equal frequency, as modes {n} to {beyond} are. Try: modes = {beyond}"
    return CutCluster(text, tuple(lanes), beyond)


def _solved(pencil: Pencil, n: int, K: Tensor, M: Tensor) -> DenseModes | SparseModes:
    """The n lowest modes, and the eigenvalue of one more if there is one."""
    if pencil.K_form.size > max(SMALL, 12 * n):
        modes = SparseModes(pencil.K_form, pencil.M_form, K, M, n)
        if not modes.exhausted:
            return modes
    return DenseModes(pencil.K_form, pencil.M_form, K, M, n)


def _gaps(modes: DenseModes | SparseModes, accuracy: Tensor, cluster: float) -> Tensor:
    """The relative gap behind each mode [lane, modes], zero within a cluster; behind the last of all modes it is NARROW."""
    values = modes.eigenvalues()
    gaps, above = values.diff(dim=1), values[:, 1:].abs()
    apart = gaps > torch.maximum(cluster * above, accuracy.maximum(ROUNDING * modes.shift.abs())[:, None])
    gaps = torch.where(apart, gaps / above, 0.0)
    return torch.nn.functional.pad(gaps, (0, 1), value=NARROW) if modes.complete else gaps


def _counts(gaps: Tensor, n: int, most: int) -> Tensor:
    """The numbers of modes [lane], of gaps [lane, at least most]; 0 where all that are allowed divide a cluster."""
    gaps = gaps[:, n - 1 : most]
    further = torch.where(gaps[:, 0] > NARROW, 0, gaps.argmax(1))
    return torch.where(gaps.gather(1, further[:, None])[:, 0] > 0.0, n + further, 0)


def _ends(modes: DenseModes | SparseModes, accuracy: Tensor, cluster: float) -> list[int]:
    """The numbers of modes behind which there is a gap, of one lane."""
    return (_gaps(modes, accuracy, cluster)[0].nonzero()[:, 0] + 1).tolist()


class PartModes(Modes):
    """`modes` of a batch, with others in the lanes of a mask `near` [lane]: those of `wide`."""

    def __init__(self, modes: Modes, near: Tensor, wide: Modes) -> None:
        self.modes, self.near, self.wide = modes, near, wide
        self.shift, self.counts = modes.shift.clone(), modes.counts.clone()
        self.shift[near], self.counts[near] = wide.shift, wide.counts

    def lowest(self) -> tuple[Tensor, Tensor]:
        of_modes, of_wide = self.modes.lowest(), self.wide.lowest()
        sizes = [max(x.shape[-1], y.shape[-1]) for x, y in zip(of_modes, of_wide, strict=True)]
        values, vectors = (_widened(x, size) for x, size in zip(of_modes, sizes, strict=True))
        values[self.near], vectors[self.near] = (_widened(x, size) for x, size in zip(of_wide, sizes, strict=True))
        return values, vectors

    def deflated_solve(self, F: Tensor) -> Tensor:
        n = int(self.modes.counts.max())
        of_others = F[..., :n].clone()
        of_others[self.near] = 0.0  # their modes are too near for it
        Z = _widened(self.modes.deflated_solve(of_others), F.shape[3])
        m = int(self.wide.counts.max())
        Z[self.near, ..., :m] = self.wide.deflated_solve(F[self.near][..., :m])
        return Z


def _widened(x: Tensor, size: int) -> Tensor:
    """A copy of x [..., n] with zeros up to [..., size]."""
    return torch.nn.functional.pad(x, (0, size - x.shape[-1])).clone()
