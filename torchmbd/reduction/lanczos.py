"""Block Lanczos iteration: the largest eigenvalues of a symmetric operator, for a batch of lanes in step.

    H Q = Q T + X R e',      Q' Q = 1,      X' Q = 0,      T = V diag(mu) V'

Q [lane, N, m] is an orthonormal basis of the block Krylov space of H, fully reorthogonalized; mu and Q V are the Ritz
values and vectors, largest first, and |R v_last| their residuals. The start block is random and has at least as many
columns as eigenvalues are wanted, so a multiple eigenvalue cannot hide copies behind its first ones.
Source: Golub and Van Loan, Matrix Computations, section 10.3; Parlett, The Symmetric Eigenvalue Problem, chapter 13.
Checked in tests/reduction/test_lanczos.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

CHECK_AT = 6  # blocks; the first look at the residuals. Each look costs a small eigenproblem


@dataclass(frozen=True)
class Ritz:
    """Ritz values `mu` [lane, m], basis `Q`, its eigenvectors `V`, and the rest `X`, `R` of the recurrence."""

    mu: Tensor
    Q: Tensor
    V: Tensor
    X: Tensor
    R: Tensor

    def vectors(self, n: int) -> Tensor:
        """The n leading Ritz vectors [lane, N, n]."""
        return self.Q @ self.V[..., :n]


def lanczos(apply: Callable[[Tensor], Tensor], start: Tensor, n: int, tolerance: float) -> Ritz | None:
    """Iterate from `start` [lane, N, p], p > n, until n pairs have residuals below tolerance relative to mu.

    The next pair is carried to 1e-4, enough to judge the gap. Returns None when the Krylov space fills half of
    the whole space before that: then a dense method is the better one.
    """
    lanes, size, p = start.shape
    most = size // (2 * p)
    X, _ = torch.linalg.qr(start)
    Q = X.new_empty((lanes, size, min(most, CHECK_AT + 4) * p))
    T = X.new_zeros((lanes, most * p, most * p))
    limit = torch.full((n + 1,), tolerance, dtype=X.dtype, device=X.device)
    limit[n] = 1e-4
    for step in range(1, most + 1):
        k = step * p
        if k > Q.shape[2]:
            Q = torch.cat([Q, torch.empty_like(Q[..., : 4 * p])], dim=2)
        Q[..., k - p : k] = X
        basis = Q[..., :k]
        W = apply(X)
        T[:, :k, k - p : k] = _orthogonalize(W, basis)
        X, R = torch.linalg.qr(W)
        if step >= CHECK_AT:
            mu, V = torch.linalg.eigh(T[:, :k, :k], UPLO="U")
            mu, V = mu.flip(-1), V.flip(-1)
            residual = torch.linalg.vector_norm(R @ V[:, -p:, : n + 1], dim=1)
            rounding = 8 * torch.finfo(mu.dtype).eps * mu[:, :1]
            if (residual <= limit * mu[:, : n + 1] + rounding).all():
                return Ritz(mu, basis, V, X, R)
        X = _repair(X, R, basis)
    return None


def _orthogonalize(W: Tensor, basis: Tensor) -> Tensor:
    """Take the components along the basis out of W in place, twice, and return them."""
    first = basis.mT @ W
    W.baddbmm_(basis, first, alpha=-1)
    second = basis.mT @ W
    W.baddbmm_(basis, second, alpha=-1)
    return first + second


def _repair(X: Tensor, R: Tensor, basis: Tensor) -> Tensor:
    """Where nothing new was left in a column, qr has put rounding in its place: make that orthogonal, too."""
    new = R.diagonal(dim1=-2, dim2=-1).abs()
    if bool((new.amin(-1) > 1e-8 * new.amax(-1)).all()):
        return X
    for _ in range(2):
        _orthogonalize(X, basis)
        X = torch.linalg.qr(X)[0]
    return X
