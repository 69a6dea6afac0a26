"""Solutions with the saddle-point matrix of the accelerations, a function of positions and data.

    K x = -R       dx = -K^-1 dR, with x held fixed in the residual R: no derivative of K, and none of its factors

K [lanes, ...] is symmetric, so cotangents are solved for with the same factors. Small matrices are dense. Large ones are
sparse: of chains and trees work and memory are linear in the bodies.
Where rows are redundant the factors are those of a regularized matrix; two steps of refinement with the exact one remove
what that changes. A lane whose matrix is singular becomes inf or nan, alone.
Source: Demmel, Eisenstat, Gilbert, Li, Liu, SIAM J. Matrix Anal. Appl. 20 (1999) 720-755 (SuperLU).
Checked in tests/multibody/system/test_saddle_factors.py: against dense matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from torch import Tensor

from torchmbd.math.first_derivative import FirstDerivative

LARGE = 150  # unknowns from which on sparse factors were faster, with one lane and with eight
REFINEMENTS = 2
Diagonal = tuple[Tensor, Tensor]  # see Dynamics.diagonal


@dataclass(frozen=True, eq=False)
class ColumnPattern:
    """Where the entries of a sparse matrix are, column after column; every diagonal entry is one of them.

    place   of each entry among those of the blocks of a saddle (saddle.py), the last of which is zero
    """

    rows: np.ndarray
    columns: np.ndarray
    starts: np.ndarray
    place: Tensor

    @classmethod
    def of(cls, row: np.ndarray, column: np.ndarray, place: np.ndarray, size: int, zero: int) -> ColumnPattern:
        """Of entries at (row, column), each once."""
        missing = np.setdiff1d(np.arange(size), row[row == column])
        row, column = np.concatenate([row, missing]), np.concatenate([column, missing])
        place = np.concatenate([place, np.full(len(missing), zero)])
        order = np.lexsort((row, column))
        starts = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=size))])
        return cls(row[order], column[order], starts, torch.from_numpy(place[order]))

    def matrix(self, entries: np.ndarray) -> scipy.sparse.csc_array:
        """Of one lane."""
        return scipy.sparse.csc_array((entries, self.rows, self.starts), shape=(len(self.starts) - 1,) * 2)


class DenseFactors:
    """Of matrices [lanes, n, n]."""

    def __init__(self, K: Tensor, diagonal: Diagonal | None):
        self.exact = None if diagonal is None else K
        self.LU, self.pivots, _ = torch.linalg.lu_factor_ex(regularized(K, diagonal))

    def solve(self, rhs: Tensor) -> Tensor:
        """K^-1 rhs [n, pair, lanes]."""
        b = rhs.permute(2, 0, 1)
        x = torch.linalg.lu_solve(self.LU, self.pivots, b)
        for _ in range(0 if self.exact is None else REFINEMENTS):
            x = x + torch.linalg.lu_solve(self.LU, self.pivots, b - self.exact @ x)
        return x.permute(1, 2, 0)


class SparseFactors:
    """Of matrices with entries [lanes, entry]."""

    def __init__(self, K: Tensor, diagonal: Diagonal | None, columns: ColumnPattern):
        entries = np.ascontiguousarray(K.numpy())  # SuperLU takes no strides
        self.exact = None if diagonal is None else [columns.matrix(x) for x in entries]
        if diagonal is not None:
            row_mask, diagonal_shift = (x.numpy() for x in diagonal)
            entries = entries * (row_mask[columns.rows] * row_mask[columns.columns])
            entries[:, columns.rows == columns.columns] -= diagonal_shift
        self.factors = [_factors(columns.matrix(x)) for x in entries]

    def solve(self, rhs: Tensor) -> Tensor:
        """K^-1 rhs [n, pair, lanes]."""
        lanes = max(len(self.factors), rhs.shape[-1])
        exact = self.exact or []
        found = np.full((*rhs.shape[:-1], lanes), np.nan)
        b = rhs.expand(*rhs.shape[:-1], lanes).numpy()
        for lane in range(lanes):
            own = lane % len(self.factors)
            factors, y = self.factors[own], np.ascontiguousarray(b[..., lane])
            if factors is None:
                continue
            x = factors.solve(y)
            for _ in range(REFINEMENTS if exact else 0):
                x += factors.solve(y - exact[own] @ x)
            found[..., lane] = x
        return torch.from_numpy(found)


def _factors(K: scipy.sparse.csc_array) -> Any:
    """Of one lane; None: there are none."""
    if not np.isfinite(K.data).all():
        return None
    try:
        return scipy.sparse.linalg.splu(K)
    except RuntimeError as error:  # SuperLU: "Factor is exactly singular"
        if "singular" not in str(error):
            raise
        return None


class Factors:
    """Factors of one batch of matrices K, made once; K may be wrapped by transforms of torch.func.

    columns   of sparse matrices; None: they are dense
    by        what K depends on: second derivatives by these are refused
    """

    def __init__(self, K: Tensor, diagonal: Diagonal | None, columns: ColumnPattern | None, by: Sequence[Tensor] = ()):
        self.K, self.diagonal, self.columns, self.by = K.detach(), diagonal, columns, by
        self._made: list[tuple[Tensor, Any]] = []

    def solve(self, rhs: Tensor) -> Tensor:
        """K^-1 rhs [n, pair, lanes], differentiable by rhs."""
        if not self.by:
            return self.of(self.K).solve(rhs)
        return _Solved.apply(self, self.K, rhs, *self.by)  # pyright: ignore[reportReturnType]

    def of(self, K: Tensor) -> DenseFactors | SparseFactors:
        """Of the plain numbers of K, or of a batch of them."""
        for known, made in self._made:
            if known.data_ptr() == K.data_ptr() and known.shape == K.shape:
                return made
        columns = self.columns
        made = DenseFactors(K, self.diagonal) if columns is None else SparseFactors(K, self.diagonal, columns)
        self._made.append((K, made))
        return made


def _folded(info: Any, in_dims: tuple, K: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor, bool]:
    """A batch as more right-hand sides, or as lanes where K is a batch too."""
    n, k, r = info.batch_size, in_dims[1], in_dims[2]
    b = rhs.expand(n, *rhs.shape) if r is None else rhs.movedim(r, 0)
    if k is None:
        return K, b.movedim(0, 1).flatten(1, 2), False
    K = K.movedim(k, 0)
    lanes = max(K.shape[1], b.shape[-1])
    wide = K.expand(n, lanes, *K.shape[2:]).flatten(0, 1)
    return wide, b.expand(*b.shape[:-1], lanes).movedim(0, -2).flatten(-2), True


def _unfolded(x: Tensor, batch: int, lanes: bool) -> Tensor:
    return x.unflatten(-1, (batch, -1)).movedim(-2, 0) if lanes else x.unflatten(1, (batch, -1)).movedim(1, 0)


class _Solved(torch.autograd.Function):
    """(factors, K, rhs, what K depends on) -> K^-1 rhs; differentiated by rhs only."""

    @staticmethod
    def forward(factors: Factors, K: Tensor, rhs: Tensor, *by: Tensor) -> Tensor:
        return factors.of(K).solve(rhs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.factors, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        K, rhs, *by = ctx.saved_tensors
        found: Any = _Slope.apply(ctx.factors, K, bars[0], *by)
        if rhs.shape[-1] < found.shape[-1]:
            found = found.sum(-1, keepdim=True)
        return None, None, found, *(None for _ in by)

    @staticmethod
    def jvp(ctx: Any, _: None, dK: Any, moved: Tensor | None, *__: Any) -> Any:
        K, rhs, *by = ctx.saved_tensors
        return _Slope.apply(ctx.factors, K, torch.zeros_like(rhs) if moved is None else moved, *by)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, factors: Factors, K: Tensor, rhs: Tensor, *by: Tensor) -> tuple[Tensor, int]:
        K, rhs, lanes = _folded(info, in_dims, K, rhs)
        return _unfolded(_Solved.apply(factors, K, rhs, *by), info.batch_size, lanes), 0  # pyright: ignore[reportArgumentType]


class _Slope(FirstDerivative):
    """The same of derivatives."""

    of = "accelerations"

    @staticmethod
    def forward(factors: Factors, K: Tensor, rhs: Tensor, *by: Tensor) -> Tensor:
        return factors.of(K).solve(rhs)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, factors: Factors, K: Tensor, rhs: Tensor, *by: Tensor) -> tuple[Tensor, int]:
        K, rhs, lanes = _folded(info, in_dims, K, rhs)
        return _unfolded(_Slope.apply(factors, K, rhs, *by), info.batch_size, lanes), 0  # pyright: ignore[reportArgumentType]


def regularized(K: Tensor, diagonal: Diagonal | None) -> Tensor:
    """Matrices K [lanes, n, n] with the changes of Dynamics.diagonal."""
    if diagonal is None:
        return K
    row_mask, diagonal_shift = diagonal
    return K * (row_mask[:, None] * row_mask) - torch.diag(diagonal_shift)
