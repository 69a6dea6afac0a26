"""Taylor series of the retained span along one line in the design space.

    K(t) Psi(t) = M(t) Psi(t) Kr(t),     Psi(t)' M(t) Psi(t) = 1,     X(t) = X_0 + t X_1 + t^2 X_2 + ...

With Psi_m = Psi_0 S_m + Z_m, Psi_0' M_0 Z_m = 0, the terms of order t^m give, as transport.py does for m = 1,

    N_m  = sum_{a+b+c = m; b, c < m} Psi_c' M_a Psi_b            S_m = -N_m / 2, symmetric
    F_m  = sum_{a+b = m; b < m} K_a Psi_b  -  sum_{a+b+c = m; b, c < m} M_a Psi_b Kr_c
    Kr_m = Psi_0' F_m + Kr_0 S_m - S_m Kr_0
    (K_0 - lambda_i M_0) z_m,i = -P f_m,i

Every order needs one more deflated solve with the factorization of the first; only gaps to discarded modes appear at
any order. No autograd inside. Checked in tests/sensitivity/test_eigenpair_branches.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.fem.reduction.transport import Pencil


def retained_series(
    pencil: Pencil, values: Tensor, psi: Tensor, K: list[Tensor], M: list[Tensor]
) -> tuple[list[Tensor], list[Tensor]]:
    """Psi_m [N, n] and Kr_m [n, n] from the Taylor coefficients of the values of K and M, all with one lane [1, ...].

    `values`, `psi`: eigenvalues [1, n] and vectors [1, N, n] at t = 0, for which `pencil` has been solved.
    """
    Psi, Kr = [psi], [torch.diag_embed(values)]
    for m in range(1, len(K)):
        M_Psi = [[pencil.M_form.multiply(M[a], Psi[b]) for b in range(m)] for a in range(m + 1)]
        terms = [(a, b, m - a - b) for a in range(m + 1) for b in range(m) if 0 <= m - a - b < m]
        N, F = torch.zeros_like(Kr[0]), torch.zeros_like(psi)
        for a, b, c in terms:
            N += Psi[c].mT @ M_Psi[a][b]
            F -= M_Psi[a][b] @ Kr[c]
        for b in range(m):
            F += pencil.K_form.multiply(K[m - b], Psi[b])
        S = -N / 2  # the sum is symmetric: with each product it holds its transpose
        Kr.append(psi.mT @ F + Kr[0] @ S - S @ Kr[0])
        Z = -pencil.modes.deflated_solve(F[:, :, None, :])[:, :, 0, :]
        Psi.append(psi @ S + Z)
    return [p[0] for p in Psi], [k[0] for k in Kr]
