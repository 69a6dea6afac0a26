"""Levels of rates that satisfy constraints: a level changes only where no rates of the levels before it would do.

    J = A1 + A2 + A3      Jacobian Phi_q: columns of the levels, zero elsewhere
    s = K x               rates s [n_v] with J s = x [rows], least sum of squares of each level
    K = C + L (1 - A C)   of a level with columns A;  L = K of the levels before it, K1 = A1+
    C = (Q A)+            Q = 1 - R L: constraint rates that the columns R of the levels before it cannot make

+ is the pseudo-inverse, for redundant and underdetermined mechanisms. With the multipliers y = C' s of a level

    ds = D + K (dx - dJ s)
    D = (1 - L A) (u - C A u) + D of the levels before it,   u = dA' y - A' L' dR' y

Rates and rows are divided by their sizes (equations/sizes.py), so that sums of squares do not depend on the unit of length.
Differentiable: `RateLevel.changes` is D, of forces J' y that have the derivatives of J.
Assumed: constant rank.
Source: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432 (pseudo-inverse of constant rank).
Checked in tests/multibody/start/test_initial.py, tests/multibody/start/test_compliant_start.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.gradients import untransformed
from torchmbd.math.pair import apply, linear
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.saddle.rank import RELATIVE

_RANK = 1e-10  # share of the largest singular value of the rigid columns of J that counts as zero


@dataclass(frozen=True, eq=False)
class RateLevel:
    """A level of rates, with the matrices of the module header.

    mask       rates of the level [n_v, 1, 1]
    A          [lanes, rows, n_v], zero in the columns of other levels; without derivatives, as all that follow
    C, K       [lanes, n_v, rows]
    made       R K: projector on the constraint rates of this level and of those before [lanes, rows, rows]
    rank       of it [lanes]
    before     the level before, which is preferred
    """

    mask: Tensor
    A: Tensor
    C: Tensor
    K: Tensor
    made: Tensor
    rank: Tensor
    before: RateLevel | None

    @classmethod
    def of(cls, J: Tensor, mask: Tensor, small: Tensor, before: RateLevel | None) -> RateLevel:
        """The level of the rates `mask` [n_v]; J [lanes, rows, n_v], small: size of a singular value that is zero [lanes]."""
        rows, columns = J.shape[1], torch.nonzero(mask)[:, 0]
        A, C = J * mask, torch.zeros_like(J.mT)
        some = J.index_select(2, columns)
        inverse, rank = _pseudo_inverse(some if before is None else some - before.made @ some, small)
        C = C.index_copy(1, columns, inverse)
        K, made = C, A @ C
        if before is not None:
            Q = torch.eye(rows, dtype=J.dtype, device=J.device) - before.made
            K, rank = C + before.K - before.K @ (A @ C), rank + before.rank
            made = before.made + Q @ made
        return cls(mask[:, None, None], A, C, K, made, rank, before)

    @property
    def complete(self) -> bool:
        """True if no constraint rate is left to the levels after it, in any lane."""
        return bool((untransformed(self.rank) == self.A.shape[1]).all())

    def changes(self, s: Tensor, forces: Callable[[Tensor], Any]) -> Any:
        """D [n_v, ...] of a correction s [n_v, 1, lanes]; forces: J' y with the derivatives of J, of y [rows, 1, lanes]."""
        D = linear(self._change, forces(apply(self.C.mT, s)))
        return D if self.before is None else D + self.before.changes(s, forces)

    def _change(self, f: Tensor) -> Tensor:
        """(1 - L A) (u - C A u) of f = dJ' y [n_v, ...]."""
        u = f * self.mask
        if self.before is not None:
            u = u - apply(self.A.mT, apply(self.before.K.mT, f))
        u = u - apply(self.C, apply(self.A, u))
        return u if self.before is None else u - apply(self.before.K, apply(self.A, u))


def rate_levels(T: Topology, J: Tensor, masks: Sequence[Tensor]) -> RateLevel:
    """The last level of the rates `masks` [n_v] that a Jacobian [lanes, rows, n_v] needs."""
    rigid = 6 * T.bodies
    level, largest = None, None
    for mask in masks:
        if bool(mask[:rigid].any()):
            largest = torch.linalg.matrix_norm(J[:, :, :rigid], 2) if largest is None else largest
            small = _RANK * largest
        else:
            small = RELATIVE * torch.linalg.matrix_norm(J[:, :, rigid:], 2)
        level = RateLevel.of(J, mask, small, level)
        if level.complete:
            break
    assert level is not None  # a system has rigid rates
    return level


def _pseudo_inverse(A: Tensor, small: Tensor) -> tuple[Tensor, Tensor]:
    """A+ [lanes, n, rows] without singular values below `small` [lanes], and the rank [lanes]."""
    U, s, V = torch.linalg.svd(A, full_matrices=False)
    independent = s > small[:, None]
    inverse = torch.where(independent, 1.0 / s, 0.0)
    return V.mT @ (inverse[..., None] * U.mT), independent.sum(1)
