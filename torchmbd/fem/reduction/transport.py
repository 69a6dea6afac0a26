"""Derivatives of the span of the retained modes in the design, on which `modal_basis` and `eigenpairs` are built.

**The problem.** K Psi = M Psi Kr and Psi' M Psi = 1, with K, M depending on the design, M positive definite, and Psi
the n lowest modes. At the design at hand Kr = diag(lambda_1 ... lambda_n). The other modes, phi_j with j > n, are
*discarded*. Let dK, dM be the derivatives in one direction of the design space, and split

    dPsi = Psi S + Z,      Psi' M Z = 0                                                                   (1)

Differentiate both equations. With F = dK Psi - dM Psi Kr:

    F + K dPsi - M dPsi Kr = M Psi dKr                                                                    (2)
    dPsi' M Psi + Psi' dM Psi + Psi' M dPsi = 0   =>   S + S' = -Psi' dM Psi                              (3)

**Only S is a matter of choice**: (3) fixes its symmetric part, and its skew part merely rotates the retained modes
among themselves. Choose the symmetric one, S = -1/2 Psi' dM Psi: dPsi then has no component inside the retained span
but for the normalization. Psi' times (2), with Psi' K Psi = Kr, Psi' K Z = Kr Psi' M Z = 0, gives the reduced
stiffness, a *full* matrix:

    dKr = Psi' F + Kr S - S Kr = Psi' dK Psi + Kr S + S Kr                                                (4)

since Psi' dM Psi Kr = -2 S Kr. Subtract M Psi Psi' times (2) from (2): with P = 1 - M Psi Psi'

    (K - lambda_i M) z_i = -P f_i,     Psi' M z_i = 0,     i = 1 ... n                                    (5)

because P K Psi S = P M Psi Kr S = 0. Expanded in the discarded modes, z_i = -sum_{j>n} phi_j (phi_j' f_i) / (lambda_j
- lambda_i). So **only gaps between a retained and a discarded eigenvalue appear**, and (5) is positive definite
there. Eigenvalues that cross, nearly cross or repeat *inside* the retained set need no special case; no gap between
them is ever divided by.

**That is all the motion needs.** Let Psi~ = Psi R with R(b) orthogonal be any other smooth basis of the same span, as
individual modes are where they exist. w = R w~ turns the reduced equations of the one into those of the other:
displacements Psi w = Psi~ w~, energy 1/2 w' Kr w, inertia invariants contracted with w, all are equal. Hence every
response is equal for all b, and so are its derivatives.

**Reverse mode** is the transpose of (1), (4), (5). For cotangents G of Psi and H of Kr, with y_i from (5) for g_i in
place of -f_i, and W = Psi' G + Kr H + H Kr:

    <G, dPsi> + <H, dKr> = sum_i -y_i' (dK - lambda_i dM) psi_i + <Psi H Psi', dK> - 1/2 <Psi W Psi', dM>  (6)

Source: Dailey (AIAA J. 27 (1989) 486-491) and Nelson (AIAA J. 14 (1976) 1201-1205) for the individual modes; (1)-(6)
are derived here. Checked in tests/sensitivity/test_eigen_subspace.py.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from torchmbd.fem.reduction.forms import Form


class DeflatedSolver(Protocol):
    """A solved eigenproblem of a batch of lanes, with its factorization for the derivatives."""

    def deflated_solve(self, F: Tensor) -> Tensor:
        """Solve (K - lambda_i M) z_i = f_i within the discarded modes; F and Z [lane, N, T, n]."""
        ...


class Pencil:
    """The forms of K and M of one eigenproblem; and, once it is solved, `modes`, its factorization."""

    modes: DeflatedSolver

    def __init__(self, K_form: Form, M_form: Form) -> None:
        self.K_form, self.M_form = K_form, M_form


def tangent(pencil: Pencil, values: Tensor, psi: Tensor, dK: Tensor | None, dM: Tensor | None) -> tuple[Tensor, Tensor]:
    """dPsi [lane, T, N, n] and dKr [lane, T, n, n] from dK, dM [lane, T, *entry] by (1), (4), (5)."""
    columns = psi[:, None]
    F = torch.zeros_like(columns)
    dKr = S = torch.zeros_like(psi[:, None, :0, :0])
    if dK is not None:
        F = pencil.K_form.multiply(dK, columns)
        dKr = columns.mT @ F
    if dM is not None:
        moved = pencil.M_form.multiply(dM, columns)
        F = F - moved * values[:, None, None, :]
        S = -(columns.mT @ moved) / 2
        shifted = S * (values[:, None, :, None] + values[:, None, None, :])
        dKr = shifted if dK is None else dKr + shifted
    dPsi = -pencil.modes.deflated_solve(F.movedim(1, 2)).movedim(2, 1)
    return (dPsi if dM is None else dPsi + columns @ S), dKr


def cotangent(pencil: Pencil, values: Tensor, psi: Tensor, G: Tensor, H: Tensor) -> tuple[Tensor, Tensor]:
    """The cotangents of K and M [lane, T, *entry] from those of Psi [lane, T, N, n] and Kr [lane, T, n, n] by (6)."""
    columns, lam = psi[:, None], values[:, None, None, :]
    Y = pencil.modes.deflated_solve(G.movedim(1, 2)).movedim(2, 1)
    W = columns.mT @ G + (values[:, None, :, None] + lam) * H
    K_bar = pencil.K_form.pair(columns @ H - Y, columns)
    M_bar = pencil.M_form.pair(Y * lam - columns @ W.mT / 2, columns)
    return K_bar, M_bar
