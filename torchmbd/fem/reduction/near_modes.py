"""Separation of modes of near eigenvalues, which rounding in the solver has mixed.

    G = Psi' K Psi,     H = Psi' M Psi       in extended precision, from the modes of the solver
    A = 1 - (H - 1) / 2 + Theta,     Theta_ij = (G_ij - (H - 1)_ij (lambda_i + lambda_j) / 2) / (lambda_j - lambda_i)

to first order A' H A = 1 and A' G A is diagonal; Theta is skew. The second order is that of rounding squared.

A solver mixes two modes at a gap g by about rounding / g, and their individual derivatives by rounding / g^2: 1e-12 and 1e-8 at
a relative gap of 1e-4, more where the norm of K is large. Psi A has what the numbers in K and M tell. What is left is
in these numbers: K rounded to double precision has modes that are mixed by the same order, and no method can undo it.
Derivatives of vectors, measured on matrices without rounding: 4e-10 at a relative gap of 6e-5, 6e-8 to 2e-7 at 8e-6, by
processor.
The span, hence every response, does not change: only individual modes do.

Pairs that are not `apart` stay as they are. Where the platform has no extended precision nothing is gained or lost.
A is a constant: the derivatives follow from it (eigenpairs.py). Checked in tests/sensitivity/test_eigen_near_gaps.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from torchmbd.fem.reduction.forms import Diagonal, Form, Sparse
from torchmbd.fem.reduction.transport import Pencil
from torchmbd.math.vmap import batch_first

Array = np.ndarray


class ModeSeparation(torch.autograd.Function):
    """A [lane, n, n] from K, M [lane, *entry], Psi [lane, N, n] and `apart`, the pairs to separate [lane, n, n]."""

    @staticmethod
    def forward(pencil: Pencil, K: Tensor, M: Tensor, psi: Tensor, apart: Tensor) -> Tensor:
        result = torch.diag_embed(torch.ones_like(psi[:, 0]))
        if not apart.any():
            return result
        for lane, turn in enumerate(result):
            P = _extended(psi[lane])
            G, H = (P.T @ _times(form, x[lane], P) for form, x in ((pencil.K_form, K), (pencil.M_form, M)))
            turn.copy_(torch.from_numpy(_turn(G, H, apart[lane].cpu().numpy()).astype(np.float64)))
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        pass

    @staticmethod
    def vmap(info: Any, in_dims: tuple, pencil: Pencil, *tensors: Tensor) -> tuple[Tensor, int]:
        wide = [batch_first(x, dim, info.batch_size) for x, dim in zip(tensors, in_dims[1:], strict=True)]
        turns = ModeSeparation.apply(pencil, *(x.flatten(0, 1) for x in wide))
        return turns.unflatten(0, (info.batch_size, -1)), 0


def _turn(G: Array, H: Array, apart: Array) -> Array:
    values, excess = G.diagonal() / H.diagonal(), H - np.eye(len(H))
    gaps = np.where(apart, values[None, :] - values[:, None], 1)
    mixed = G - excess * (values[None, :] + values[:, None]) / 2
    eye = np.eye(len(H))
    A = eye - excess / 2 + np.where(apart, (mixed + mixed.T) / 2 / gaps, 0)
    for _ in range(2):  # next to rounding Theta is no small turn: the sums over neighbors see whether A' H A = 1
        A = A @ (1.5 * eye - 0.5 * (A.T @ H @ A))
    return A


def _times(form: Form, values: Tensor, X: Array) -> Array:
    numbers = _extended(values)
    if isinstance(form, Diagonal):
        return numbers[:, None] * X
    if isinstance(form, Sparse):
        return csr_array((numbers, form.pattern.indices, form.pattern.indptr), shape=(form.size,) * 2) @ X
    return numbers @ X


def _extended(x: Tensor) -> Array:
    return x.detach().cpu().numpy().astype(np.longdouble)
