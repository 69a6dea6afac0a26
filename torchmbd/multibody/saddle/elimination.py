"""Solving with a saddle-point matrix: by triangular factors, or by block elimination with the inverses of the bodies' blocks.

    [ K  B ]^-1   [ X - X B Y C X    X B Y ]       X = K^-1, block by block: one block for each body
    [ C  E ]    = [     Y C X         -Y   ]       Y = (C X B - E)^-1: of the size of the constraints

A mechanism of many bodies has a K of small blocks; the cost of a dense inverse grows with the cube of their number. Block
elimination is faster for large systems (`pays`). A lane with a singular block (a body without inertia) takes the dense factors.
Not for systems with applied forces or beams, which couple the blocks of bodies.
Checked in tests/multibody/saddle/test_elimination.py: against the dense inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.multibody.equations.topology import Topology

_LARGE, _MANY = 90, 4  # least numbers of unknowns and bodies with which it was faster than the dense inverse


def pays(T: Topology) -> bool:
    """True if elimination is possible and faster than a dense inverse."""
    return not T.actions and not T.has_fast_elements and T.bodies >= _MANY and T.n_v + T.rows >= _LARGE


class Elimination:
    """Block elimination for the matrices of one topology."""

    def __init__(self, T: Topology):
        self.n_v = T.n_v
        by_size: dict[int, list[list[int]]] = {}
        for rows in rates_of_bodies(T):
            if rows:
                by_size.setdefault(len(rows), []).append(rows)
        self.groups = [torch.tensor(rows, dtype=torch.long) for rows in by_size.values()]  # [bodies, rates of each]

    def __call__(self, A: Tensor) -> Eliminated:
        """Inverses of matrices [lanes, n, n]; nan in lanes whose matrix is singular."""
        n = self.n_v
        B, C, E = A[:, :n, n:], A[:, n:, :n], A[:, n:, n:]
        X, XB, CX = [], torch.empty_like(B), torch.empty_like(C)
        singular = torch.zeros(len(A), dtype=torch.bool, device=A.device)
        for rows in self.groups:
            x, info = torch.linalg.inv_ex(A[:, rows[:, :, None], rows[:, None, :]])
            singular |= (info != 0).any(1)
            X.append(x)
            XB[:, rows] = x @ B[:, rows]
            CX[:, :, rows] = (C[:, :, rows].permute(0, 2, 1, 3) @ x).permute(0, 2, 1, 3)
        lanes = singular.nonzero()[:, 0]
        return Eliminated(self.groups, X, XB, CX, factored(C @ XB - E), lanes, factored(A[lanes]))


@dataclass(frozen=True)
class Eliminated:
    """Inverses as products, as a full inverse would cost more to form than all factors.

    groups         rates of the bodies with blocks of the same size [bodies, k]
    X, XB, CX, Y   of the module header; X for each group [lanes, bodies, k, k]
    lanes, dense   lanes with a singular block, and the factors of their whole matrices
    """

    groups: list[Tensor]
    X: list[Tensor]
    XB: Tensor
    CX: Tensor
    Y: Factored
    lanes: Tensor
    dense: Factored

    def __matmul__(self, b: Tensor) -> Tensor:
        """The inverses times columns [lanes, n, k]."""
        b, n = b.contiguous(), self.XB.shape[1]  # with other strides torch multiplies lane by lane, many times slower
        top, bottom = b[:, :n], b[:, n:]
        below = self.Y @ (self.CX @ top - bottom)
        above = torch.empty_like(top)
        for rows, X in zip(self.groups, self.X, strict=True):
            above[:, rows] = X @ top[:, rows]
        x = torch.cat([above - self.XB @ below, below], 1)
        if len(self.lanes):
            x[self.lanes] = self.dense @ b[self.lanes]
        return x


@dataclass(frozen=True)
class Factored:
    """Triangular factors of matrices [lanes, n, n]; multiplication by the inverses is a solution with the factors."""

    LU: Tensor
    pivots: Tensor

    def __matmul__(self, b: Tensor) -> Tensor:
        """The inverses times columns [lanes, n, k]."""
        return torch.linalg.lu_solve(self.LU, self.pivots, b)


def factored(K: Tensor) -> Factored:
    """Factors of matrices [lanes, n, n]; nan in lanes whose matrix is singular."""
    LU, pivots, info = torch.linalg.lu_factor_ex(K)
    if bool(info.any()):
        LU = torch.where((info == 0)[:, None, None], LU, torch.nan)
    return Factored(LU, pivots)


def rates_of_bodies(T: Topology) -> list[list[int]]:
    """Rows of v of each body; in a condensed system its independent rates."""
    rates = [[k * T.bodies + b for k in range(6)] for b in range(T.bodies)]
    for f in range(T.flexible):
        rates[f] += [6 * T.bodies + a * T.flexible + f for a in range(T.modes)]
    if T.rates is None:
        return rates
    return [torch.nonzero((T.rates[rows] != 0).any(0))[:, 0].tolist() for rows in rates]
