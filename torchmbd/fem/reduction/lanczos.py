"""Block Lanczos iteration: the largest eigenvalues of a symmetric operator, for a batch of lanes in step.

    H Q = Q T + X R e',      Q' Q = 1,      X' Q = 0,      T = V diag(mu) V'

Q [lane, N, m] is an orthonormal basis of the block Krylov space of H, fully reorthogonalized; mu and Q V are the Ritz
values and vectors, largest first, and |R v_last| their residuals.
A block of p columns finds at most p copies of a multiple eigenvalue, and small blocks need far fewer products with H.
So the block is small, and where p wanted eigenvalues lie close together a probe tells whether a copy was missed: an iteration
from p random vectors, with H in the complement of Q. If it misses an eigenvalue mu, the chance that its largest Ritz value
theta is still below (1 - gap) mu after k steps is at most

    (1.648 sqrt(N) exp(-sqrt(gap) (2 k - 1)))^p

The bound distinguishes a missed eigenvalue from unwanted ones just below the wanted ones. If one was missed, the iteration
starts again with more columns than wanted eigenvalues.
Source: Golub and Van Loan, Matrix Computations, section 10.3; Parlett, The Symmetric Eigenvalue Problem, chapter 13. Chance
of one column: Kuczynski and Wozniakowski, SIAM J. Matrix Anal. Appl. 13 (1992), theorem 4.1; the columns are independent.
Checked in tests/fem/reduction/test_lanczos.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchmbd.math.lane_groups import by_groups
from torchmbd.math.module_call import outside_transforms

BLOCK = 8  # columns, which fill the registers of a processor
CLOSE = (
    0.1  # relative distance; where as many eigenvalues as the block has columns are so near, one may have been missed
)
NEXT = 1e-4  # residual of the pair after the last wanted: enough to judge the gap
PROBES = 3  # steps of a probe between two looks at its Ritz values
CHANCE = 1e-4  # that a probe overlooks a missed eigenvalue, at most
SAMPLE = 4  # lanes whose convergence is checked first: where these have not converged the others are not checked
SPREAD = 30  # residuals of other lanes are up to so many times those of the sample, in four of five batches of plates


@dataclass(frozen=True)
class Ritz:
    """Ritz values `mu` [lane, m], basis `Q`, eigenvectors `V` of T, and the remainder `X`, `R` (module header)."""

    mu: Tensor
    Q: Tensor
    V: Tensor
    X: Tensor
    R: Tensor

    def residuals(self) -> Tensor:
        """|H u - mu u| / mu of every Ritz pair [lane, m]."""
        return torch.linalg.vector_norm(self.R @ self.V[:, -self.R.shape[-1] :], dim=1) / self.mu


class Recurrence:
    """Block Lanczos after `steps` steps: Q [lane, N, columns], T [lane, columns, columns] above the diagonal, X and R.

    Q and T may have more columns than the steps have filled. Compiled code needs Q row by row; operators of torch take half the
    time `by_columns`.
    """

    def __init__(self, X: Tensor, by_columns: bool = False) -> None:
        lanes, size, p = X.shape
        self.X, self.R, self._by_columns = X.contiguous(), X.new_zeros(lanes, p, p), by_columns
        self.Q, self.T = X.new_zeros(lanes, size, 0), X.new_zeros(lanes, 0, 0)
        self.steps = 0

    def reserve(self, steps: int) -> None:
        """Allocate the columns of so many steps."""
        missing = steps * self.X.shape[2] - self.Q.shape[2]
        if missing <= 0:
            return
        pad = torch.nn.functional.pad
        if self._by_columns:  # memory of columns that no step fills is never touched
            lanes, size, columns = self.Q.shape
            filled, self.Q = self.Q, self.Q.new_empty(lanes, columns + missing, size).mT
            self.Q[..., :columns] = filled
        else:
            self.Q = pad(self.Q, (0, missing))
        self.T = pad(self.T, (0, missing, 0, missing))

    def extend(self, apply: Callable[[Tensor], Tensor], steps: int) -> None:
        """Continue to so many steps in all."""
        p = self.X.shape[2]
        for k in range(self.steps * p, steps * p, p):
            self.Q[..., k : k + p] = self.X
            basis = self.Q[..., : k + p]
            W = apply(self.X)
            taken = self.T[:, : k + p, k : k + p] = _orthogonalize(W, basis, 2 * p)
            X, self.R = torch.linalg.qr(W)
            self.X = _repair(X, self.R, basis, taken)
        self.steps = steps

    def ritz(self, stride: int) -> Ritz:
        """Return the Ritz pairs of each `stride`-th lane."""
        k = self.steps * self.X.shape[2]
        mu, V = by_groups(lambda T: tuple(torch.linalg.eigh(T, UPLO="U")), self.T[::stride, :k, :k])
        return Ritz(mu.flip(-1), self.Q[::stride, :, :k], V.flip(-1), self.X[::stride], self.R[::stride])


def lanczos(
    apply: Callable[[Tensor], Tensor],
    start: tuple[int, int] | Recurrence,
    n: int,
    tolerance: float,
    extend: Callable[[Recurrence, int], None] | None = None,
) -> tuple[Ritz | None, Recurrence]:
    """Iterate until n pairs in every lane have residuals below tolerance, relative to mu.

    start:  lanes and rows, or the recurrence of fewer pairs, which is continued
    extend: a faster implementation of `Recurrence.extend` with `apply`
    Returns None for the pairs when the Krylov space fills half of the whole space before that: a dense method is faster then.
    """
    by_columns = extend is None
    extend = extend or (lambda recurrence, steps: recurrence.extend(apply, steps))
    recurrence = start if isinstance(start, Recurrence) else Recurrence(_random(*start, BLOCK), by_columns)
    ritz = _iterate(extend, recurrence, n, tolerance)
    if ritz is not None:
        lanes, size, p = recurrence.X.shape
        mu = ritz.mu[:, : n + 1]
        first, last = mu[:, : 1 - p], mu[:, p - 1 :]  # of as many neighbors as a block has columns
        if (first - last <= CLOSE * first).any() and misses_eigenvector(apply, ritz, n):
            recurrence = Recurrence(_random(lanes, size, n + 2), by_columns)
            ritz = _iterate(extend, recurrence, n, tolerance)
    return ritz, recurrence


def _random(lanes: int, size: int, columns: int, seed: int | None = None) -> Tensor:
    """Return orthonormal columns, the same ones in every lane and in every run; other ones with a `seed`."""
    return _start(size, columns, columns if seed is None else seed).repeat(lanes, 1, 1)


@lru_cache(maxsize=8)  # of the bodies of a system: each design begins with the same columns
def _start(size: int, columns: int, seed: int) -> Tensor:
    """The columns of one lane [size, columns]."""
    start = np.random.default_rng(seed).standard_normal((size, columns))  # torch's may not be drawn under vmap
    with torch.inference_mode(False):
        return outside_transforms(lambda: torch.linalg.qr(torch.from_numpy(start))[0])


def _iterate(
    extend: Callable[[Recurrence, int], None], recurrence: Recurrence, n: int, tolerance: float
) -> Ritz | None:
    lanes, size, p = recurrence.X.shape
    steps, ahead = max(4 * (n + 2) // p, 2, recurrence.steps), False
    while steps <= size // (2 * p):
        if steps > recurrence.steps:
            if steps * p > recurrence.Q.shape[2]:
                recurrence.reserve(2 * steps)  # to move the columns costs as much as a step
            extend(recurrence, steps)
        for stride in dict.fromkeys((max(lanes // SAMPLE, 1), 1)):
            ritz = recurrence.ritz(stride)
            excess = _excess(ritz, n, tolerance)
            if stride > 1 and excess <= 1 < SPREAD * excess and not ahead:
                excess, ahead = SPREAD * excess, True  # one more step costs less than to check all lanes twice
            if excess > 1:
                break
        else:
            return ritz
        steps += _steps_to_go(excess, tolerance, steps - n // p)
    return None


def _excess(ritz: Ritz, n: int, tolerance: float) -> float:
    """The largest residual of the wanted pairs as a multiple of its limit."""
    mu = ritz.mu[:, : n + 1]
    limit = torch.full_like(mu, tolerance)
    limit[:, n] = NEXT
    rounding = 8 * torch.finfo(mu.dtype).eps * mu[:, :1] / mu
    return (ritz.residuals()[:, : n + 1] / (limit + rounding)).max().item()


def _steps_to_go(excess: float, tolerance: float, steps: int) -> int:
    """Estimate the number of further steps (1 to 3): residuals fall about geometrically, from one at the start to `excess`."""
    fallen = math.log(excess * tolerance) / max(steps, 1)
    return min(max(math.floor(math.log(excess) / -fallen), 1), 3) if fallen < 0 else 3


def _orthogonalize(W: Tensor, basis: Tensor, recent: int) -> Tensor:
    """Remove the components along the basis from W in place, and return them.

    But for rounding they lie in the last two blocks: these are removed first, then all once more.
    """
    near = basis[..., -recent:]
    first = near.mT @ W
    W.baddbmm_(near, first, alpha=-1)
    second = basis.mT @ W
    W.baddbmm_(basis, second, alpha=-1)
    second[:, -first.shape[1] :] += first
    return second


def _repair(X: Tensor, R: Tensor, basis: Tensor, taken: Tensor) -> Tensor:
    """Orthogonalize columns of X against the basis where the new block was zero but for rounding.

    taken: components that `_orthogonalize` removed, whose rounding such columns are
    """
    new = R.diagonal(dim1=-2, dim2=-1).abs()
    if bool((new.amin(-1) > torch.maximum(1e-8 * new.amax(-1), 1e-12 * taken.abs().amax((-2, -1)))).all()):
        return X
    for _ in range(2):
        _orthogonalize(X, basis, X.shape[2])
        X = torch.linalg.qr(X)[0]
    return X


def misses_eigenvector(apply: Callable[[Tensor], Tensor], ritz: Ritz, n: int) -> bool:
    """True if one of the n wanted eigenvectors of H is orthogonal to Q, and so was missed.

    The answer is True also where the probe remains uncertain after as many steps as Q has taken.
    """
    lanes, size, columns = ritz.Q.shape

    def outside(X: Tensor) -> Tensor:
        HX = apply(X)
        _orthogonalize(HX, ritz.Q, 1)
        return HX

    start = _random(lanes, size, BLOCK, seed=0)
    _orthogonalize(start, ritz.Q, 1)
    probe = Recurrence(torch.linalg.qr(start)[0], by_columns=True)
    last, beyond = ritz.mu[:, n - 1], ritz.mu[:, n]
    limit = (0.5 * (last + beyond)).maximum(
        (1 + NEXT) * beyond
    )  # a copy of the pair beyond the wanted ones is not missed
    for steps in range(PROBES, max(columns // ritz.X.shape[2], PROBES) + 1, PROBES):
        probe.reserve(steps)
        probe.extend(outside, steps)
        gap = (1 - probe.ritz(1).mu[:, 0] / limit).min().item()
        if gap < 0:
            return True
        if BLOCK * (math.log(1.648 * math.sqrt(size)) - math.sqrt(gap) * (2 * steps - 1)) <= math.log(CHANCE):
            return False
    return True
