"""Block Lanczos iteration: the largest eigenvalues of a symmetric operator, for a batch of lanes in step.

    H Q = Q T + X R e',      Q' Q = 1,      X' Q = 0,      T = V diag(mu) V'

Q [lane, N, m] is an orthonormal basis of the block Krylov space of H, fully reorthogonalized; mu and Q V are the Ritz
values and vectors, largest first, and |R v_last| their residuals.
A block of p columns finds at most p copies of a multiple eigenvalue, and small blocks need far fewer products with H.
So the block is small, and where p wanted eigenvalues lie close together a probe tells whether a copy was missed: a random
vector orthogonal to Q is iterated with H, and must not grow as the wanted eigenvectors do. If it does, the iteration
starts again with more columns than wanted eigenvalues.
Source: Golub and Van Loan, Matrix Computations, section 10.3; Parlett, The Symmetric Eigenvalue Problem, chapter 13.
Checked in tests/fem/reduction/test_lanczos.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

BLOCK = 8  # columns, which fill the registers of a processor
CLOSE = 0.1  # relative distance of as many eigenvalues as the block has columns at which one more may be there
NEXT = 1e-4  # residual of the pair after the last wanted: enough to judge the gap
PROBES, SUSPICIOUS = 3, 0.7
SAMPLE = 4  # lanes that are looked at first: where these have not converged the others need not be asked


@dataclass(frozen=True)
class Ritz:
    """Ritz values `mu` [lane, m], basis `Q`, its eigenvectors `V`, and the rest `X`, `R` of the recurrence."""

    mu: Tensor
    Q: Tensor
    V: Tensor
    X: Tensor
    R: Tensor

    def residuals(self) -> Tensor:
        """|H u - mu u| / mu of every Ritz pair [lane, m]."""
        return torch.linalg.vector_norm(self.R @ self.V[:, -self.R.shape[-1] :], dim=1) / self.mu


class Recurrence:
    """What `steps` steps have found: columns of Q [lane, N, room], of T [lane, room, room] above the diagonal, X, R."""

    def __init__(self, X: Tensor) -> None:
        lanes, size, p = X.shape
        self.X, self.R = X.contiguous(), X.new_zeros(lanes, p, p)
        self.Q, self.T = X.new_zeros(lanes, size, 0), X.new_zeros(lanes, 0, 0)
        self.steps = 0

    def make_room(self, steps: int) -> None:
        """For more columns."""
        if (missing := steps * self.X.shape[2] - self.Q.shape[2]) > 0:
            self.Q = torch.nn.functional.pad(self.Q, (0, missing))
            self.T = torch.nn.functional.pad(self.T, (0, missing, 0, missing))

    def go_on(self, apply: Callable[[Tensor], Tensor], steps: int) -> None:
        """Up to so many steps."""
        p = self.X.shape[2]
        for k in range(self.steps * p, steps * p, p):
            self.Q[..., k : k + p] = self.X
            basis = self.Q[..., : k + p]
            W = apply(self.X)
            taken = self.T[:, : k + p, k : k + p] = _orthogonalize(W, basis, 2 * p)
            X, self.R = torch.linalg.qr(W)
            self.X = _repair(X, self.R, basis, taken)
        self.steps = steps

    def ritz(self, every: int) -> Ritz:
        """Of every so many lanes."""
        k = self.steps * self.X.shape[2]
        mu, V = torch.linalg.eigh(self.T[::every, :k, :k], UPLO="U")
        return Ritz(mu.flip(-1), self.Q[::every, :, :k], V.flip(-1), self.X[::every], self.R[::every])


def lanczos(
    apply: Callable[[Tensor], Tensor],
    lanes: int,
    size: int,
    n: int,
    tolerance: float,
    device: torch.device | None = None,
    go_on: Callable[[Recurrence, int], None] | None = None,
) -> Ritz | None:
    """Iterate until n pairs in every lane have residuals below tolerance, relative to mu.

    go_on: does the same as Recurrence.go_on with `apply`
    Returns None when the Krylov space fills half of the whole space before that: then a dense method is the better one.
    """
    go_on = go_on or (lambda found, steps: found.go_on(apply, steps))
    ritz = _iterate(go_on, _random(lanes, size, BLOCK, device), n, tolerance)
    if ritz is not None and _crowded(ritz.mu[:, : n + 1]) and misses_a_copy(apply, ritz, n):
        ritz = _iterate(go_on, _random(lanes, size, n + 2, device), n, tolerance)
    return ritz


def _random(lanes: int, size: int, columns: int, device: torch.device | None) -> Tensor:
    """The same orthonormal columns in every lane, and in every run."""
    start = np.random.default_rng(columns).standard_normal((size, columns))  # torch's may not be drawn under vmap
    return torch.linalg.qr(torch.from_numpy(start))[0].repeat(lanes, 1, 1).to(device)


def _crowded(mu: Tensor) -> bool:
    """Whether as many of mu [lane, n] lie close together as a block has columns."""
    first, last = mu[:, : 1 - BLOCK], mu[:, BLOCK - 1 :]
    return bool((first - last <= CLOSE * first).any())


def _iterate(go_on: Callable[[Recurrence, int], None], X: Tensor, n: int, tolerance: float) -> Ritz | None:
    lanes, size, p = X.shape
    found, look = Recurrence(X), max(4 * (n + 2) // p, 2)
    while look <= size // (2 * p):
        found.make_room(look)
        go_on(found, look)
        for every in dict.fromkeys((max(lanes // SAMPLE, 1), 1)):
            ritz = found.ritz(every)
            excess = _excess(ritz, n, tolerance)
            if excess > 1:
                break
        else:
            return ritz
        look += _steps_to_go(excess, tolerance, look - n // p)
    return None


def _excess(ritz: Ritz, n: int, tolerance: float) -> float:
    """The largest residual of the wanted pairs as a multiple of what is asked for."""
    mu = ritz.mu[:, : n + 1]
    limit = torch.full_like(mu, tolerance)
    limit[:, n] = NEXT
    rounding = 8 * torch.finfo(mu.dtype).eps * mu[:, :1] / mu
    return (ritz.residuals()[:, : n + 1] / (limit + rounding)).max().item()


def _steps_to_go(excess: float, tolerance: float, steps: int) -> int:
    """Residuals fall about geometrically, faster at the end: continue the line from one to where they are now."""
    fallen = math.log(excess * tolerance) / max(steps, 1)
    return min(max(math.floor(math.log(excess) / -fallen), 1), 3) if fallen < 0 else 3


def _orthogonalize(W: Tensor, basis: Tensor, recent: int) -> Tensor:
    """Take the components along the basis out of W in place and return them.

    But for rounding all of them lie in the last two blocks: those first, then once more everything.
    """
    near = basis[..., -recent:]
    first = near.mT @ W
    W.baddbmm_(near, first, alpha=-1)
    second = basis.mT @ W
    W.baddbmm_(basis, second, alpha=-1)
    second[:, -first.shape[1] :] += first
    return second


def _repair(X: Tensor, R: Tensor, basis: Tensor, taken: Tensor) -> Tensor:
    """Where nothing new was left in a column, qr has put rounding in its place: make that orthogonal, too.

    taken: what was taken out before, whose rounding it is
    """
    new = R.diagonal(dim1=-2, dim2=-1).abs()
    if bool((new.amin(-1) > torch.maximum(1e-8 * new.amax(-1), 1e-12 * taken.abs().amax((-2, -1)))).all()):
        return X
    for _ in range(2):
        _orthogonalize(X, basis, X.shape[2])
        X = torch.linalg.qr(X)[0]
    return X


def misses_a_copy(apply: Callable[[Tensor], Tensor], ritz: Ritz, n: int) -> bool:
    """Whether H has an eigenvector orthogonal to Q that belongs to the n wanted ones."""
    lanes, size, _ = ritz.Q.shape
    X = _random(lanes, size, 2, ritz.Q.device)
    growth = torch.zeros_like(ritz.mu[:, 0])
    for _ in range(PROBES):
        _orthogonalize(X, ritz.Q, 1)
        X = torch.linalg.qr(X)[0]
        HX = apply(X)
        growth = torch.linalg.vector_norm(X.mT @ HX, dim=(1, 2))
        X = HX
    return bool((growth > SUSPICIOUS * ritz.mu[:, n]).any())
