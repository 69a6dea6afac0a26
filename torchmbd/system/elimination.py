"""Block elimination: the inverse of a saddle-point matrix from those of the bodies' own blocks.

    [ K  B ]^-1   [ X - X B Y C X    X B Y ]       X = K^-1, block by block: one block for each body
    [ C  E ]    = [     Y C X         -Y   ]       Y = (C X B - E)^-1: of the size of the constraints

A mechanism of many bodies has a K of small blocks: what a dense inverse spends on their zeros grows with the cube of
their number. Worth it from some size on (`pays`); a lane with a singular block (a body without inertia) goes the dense way.
Applied forces couple bodies through their laws: not for them.
Checked in tests/system/test_elimination.py: against the dense inverse.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.system.topology import Topology

_LARGE, _MANY = 90, 4  # unknowns and bodies from which on it was faster than the dense inverse


def pays(T: Topology) -> bool:
    """Whether elimination is possible and faster than a dense inverse."""
    return not T.actions and T.bodies >= _MANY and T.n_v + T.rows >= _LARGE


class Elimination:
    """Inverses of the matrices of one topology."""

    def __init__(self, T: Topology):
        self.n_v = T.n_v
        by_size: dict[int, list[list[int]]] = {}
        for rows in own_rates(T):
            if rows:
                by_size.setdefault(len(rows), []).append(rows)
        self.groups = [torch.tensor(rows, dtype=torch.long) for rows in by_size.values()]  # [bodies, rates of each]

    def __call__(self, A: Tensor) -> Tensor:
        """Inverses of matrices [lanes, n, n]; a lane whose matrix is singular becomes nan, alone."""
        n = self.n_v
        B, C, E = A[:, :n, n:], A[:, n:, :n], A[:, n:, n:]
        X = torch.zeros_like(A[:, :n, :n])
        XB, CX = torch.empty_like(B), torch.empty_like(C)
        singular = torch.zeros(len(A), dtype=torch.bool, device=A.device)
        for rows in self.groups:
            at = rows[:, :, None], rows[:, None, :]
            x, info = torch.linalg.inv_ex(A[:, at[0], at[1]])
            singular |= (info != 0).any(1)
            X[:, at[0], at[1]] = x
            XB[:, rows] = x @ B[:, rows]
            CX[:, :, rows] = (C[:, :, rows].permute(0, 2, 1, 3) @ x).permute(0, 2, 1, 3)
        Y = inverse(C @ XB - E)
        XBY = XB @ Y
        H = torch.cat([torch.cat([X - XBY @ CX, XBY], 2), torch.cat([Y @ CX, -Y], 2)], 1)
        if bool(singular.any()):
            H[singular] = inverse(A[singular])
        return H


def inverse(K: Tensor) -> Tensor:
    """Inverses of matrices [lanes, n, n]. A lane whose matrix is singular becomes nan, alone."""
    H, info = torch.linalg.inv_ex(K)
    if not K.is_cuda and not bool(info.any()):
        return H
    return torch.where((info == 0)[:, None, None], H, torch.nan)


def own_rates(T: Topology) -> list[list[int]]:
    """Rows of v (independent ones, where a condensation left them) of each body."""
    whole = [[k * T.bodies + b for k in range(6)] for b in range(T.bodies)]
    for f in range(T.flexible):
        whole[f] += [6 * T.bodies + a * T.flexible + f for a in range(T.modes)]
    if T.rates is None:
        return whole
    return [torch.nonzero((T.rates[rows] != 0).any(0))[:, 0].tolist() for rows in whole]
