"""Solutions with the saddle-point matrix of the accelerations, which depends on positions and data.

    K x = -R       dx = -K^-1 dR at fixed x in the residual R: derivatives of K and of its factors are not needed

K [lanes, ...] is symmetric, so cotangents are solved for with the same factors. Small matrices are dense. Large ones are
sparse: for chains and trees work and memory are linear in the number of bodies.
Where rows are redundant the factors are those of a regularized matrix; two steps of iterative refinement with the exact matrix
remove the error. In a lane whose matrix is singular, and only there, the solution is inf or nan.
Source: Demmel, Eisenstat, Gilbert, Li, Liu, SIAM J. Matrix Anal. Appl. 20 (1999) 720-755 (SuperLU).
Checked in tests/multibody/saddle/test_factors.py: against dense matrices.
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

from torchmbd.math.vmap import FirstDerivative

LARGE = 150  # least number of unknowns with which sparse factors were faster, with one lane and with eight
REFINEMENTS = 2
Diagonal = tuple[Tensor, Tensor]  # see Dynamics.diagonal


@dataclass(frozen=True, eq=False)
class ColumnPattern:
    """Pattern of a sparse matrix, column after column, with all diagonal entries.

    entry   number of each entry among those of the blocks (saddle.entry_numbers)
    """

    rows: np.ndarray
    columns: np.ndarray
    starts: np.ndarray
    entry: Tensor

    @classmethod
    def of(cls, row: np.ndarray, column: np.ndarray, entry: np.ndarray, size: int, zero: int) -> ColumnPattern:
        """The pattern of entries at (row, column), each once; zero: number of an entry that is always zero."""
        missing = np.setdiff1d(np.arange(size), row[row == column])
        row, column = np.concatenate([row, missing]), np.concatenate([column, missing])
        entry = np.concatenate([entry, np.full(len(missing), zero)])
        order = np.lexsort((row, column))
        starts = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=size))])
        return cls(row[order], column[order], starts, torch.from_numpy(entry[order]))

    def matrix(self, entries: np.ndarray) -> scipy.sparse.csc_array:
        """The matrix of one lane out of its entries in the order of the pattern."""
        return scipy.sparse.csc_array((entries, self.rows, self.starts), shape=(len(self.starts) - 1,) * 2)


class DenseFactors:
    """Factors of dense matrices K [lanes, n, n]."""

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
    """Factors of sparse matrices with entries K [lanes, entry]."""

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
        solution = np.full((*rhs.shape[:-1], lanes), np.nan)
        b = rhs.expand(*rhs.shape[:-1], lanes).numpy()
        for lane in range(lanes):
            k = lane % len(self.factors)  # one matrix, or one for each lane
            factors, y = self.factors[k], np.ascontiguousarray(b[..., lane])
            if factors is None:
                continue
            x = factors.solve(y)
            for _ in range(REFINEMENTS if exact else 0):
                x += factors.solve(y - exact[k] @ x)
            solution[..., lane] = x
        return torch.from_numpy(solution)


def _factors(K: scipy.sparse.csc_array) -> Any:
    """Factors of one lane; None where the matrix is singular or not finite."""
    if not np.isfinite(K.data).all():
        return None
    try:
        return scipy.sparse.linalg.splu(K)
    except RuntimeError as error:  # SuperLU: "Factor is exactly singular"
        if "singular" not in str(error):
            raise
        return None


class Factors:
    """Factors of one batch of matrices K, computed once; K may be wrapped by transforms of torch.func.

    columns   pattern of sparse matrices; None: they are dense
    """

    def __init__(self, K: Tensor, diagonal: Diagonal | None, columns: ColumnPattern | None):
        self.K, self.diagonal, self.columns = K.detach(), diagonal, columns
        self._cache: list[tuple[Tensor, Any]] = []

    def solve(self, rhs: Tensor, inputs: Sequence[Tensor] = ()) -> Tensor:
        """K^-1 rhs [n, pair, lanes], differentiable with respect to rhs.

        inputs    tensors with derivatives that K or rhs depends on: second derivatives with respect to these are refused
        """
        if not inputs:
            return self.of(self.K).solve(rhs)
        return _Solve.apply(self, self.K, rhs, *inputs)  # pyright: ignore[reportReturnType]

    def of(self, K: Tensor) -> DenseFactors | SparseFactors:
        """Factors of K without wrappers of torch.func, or of a batch of K."""
        for known, factors in self._cache:
            if known.data_ptr() == K.data_ptr() and known.shape == K.shape:
                return factors
        columns = self.columns
        factors = DenseFactors(K, self.diagonal) if columns is None else SparseFactors(K, self.diagonal, columns)
        self._cache.append((K, factors))
        return factors


def _of_batch(
    solve: type[torch.autograd.Function],
    info: Any,
    in_dims: tuple,
    factors: Factors,
    K: Tensor,
    rhs: Tensor,
    *inputs: Tensor,
) -> tuple[Tensor, int]:
    """Solutions of a batch of vmap: as more right-hand sides, or as more lanes where K is a batch too."""
    n, k, r = info.batch_size, in_dims[1], in_dims[2]
    b = rhs.expand(n, *rhs.shape) if r is None else rhs.movedim(r, 0)
    if k is None:
        x: Any = solve.apply(factors, K, b.movedim(0, 1).flatten(1, 2), *inputs)
        return x.unflatten(1, (n, -1)).movedim(1, 0), 0
    K = K.movedim(k, 0)
    lanes = max(K.shape[1], b.shape[-1])
    wide = K.expand(n, lanes, *K.shape[2:]).flatten(0, 1)
    x = solve.apply(factors, wide, b.expand(*b.shape[:-1], lanes).movedim(0, -2).flatten(-2), *inputs)
    return x.unflatten(-1, (n, -1)).movedim(-2, 0), 0


class _Solve(torch.autograd.Function):
    """(factors, K, rhs, inputs of K) -> K^-1 rhs; differentiated by rhs only."""

    @staticmethod
    def forward(factors: Factors, K: Tensor, rhs: Tensor, *inputs: Tensor) -> Tensor:
        return factors.of(K).solve(rhs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.factors, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        K, rhs, *inputs = ctx.saved_tensors
        by_rhs: Any = _SolveDerivative.apply(ctx.factors, K, cotangents[0], *inputs)
        if rhs.shape[-1] < by_rhs.shape[-1]:
            by_rhs = by_rhs.sum(-1, keepdim=True)
        return None, None, by_rhs, *(None for _ in inputs)

    @staticmethod
    def jvp(ctx: Any, _: None, dK: Any, drhs: Tensor | None, *__: Any) -> Any:
        K, rhs, *inputs = ctx.saved_tensors
        return _SolveDerivative.apply(ctx.factors, K, torch.zeros_like(rhs) if drhs is None else drhs, *inputs)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple, factors: Factors, K: Tensor, rhs: Tensor, *inputs: Tensor
    ) -> tuple[Tensor, int]:
        return _of_batch(_Solve, info, in_dims, factors, K, rhs, *inputs)


class _SolveDerivative(FirstDerivative):
    """K^-1 rhs for derivatives rhs; has no derivative itself."""

    of = "accelerations"

    @staticmethod
    def forward(factors: Factors, K: Tensor, rhs: Tensor, *inputs: Tensor) -> Tensor:
        return factors.of(K).solve(rhs)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple, factors: Factors, K: Tensor, rhs: Tensor, *inputs: Tensor
    ) -> tuple[Tensor, int]:
        return _of_batch(_SolveDerivative, info, in_dims, factors, K, rhs, *inputs)


def regularized(K: Tensor, diagonal: Diagonal | None) -> Tensor:
    """Matrices K [lanes, n, n] with the regularization of `Dynamics.diagonal`."""
    if diagonal is None:
        return K
    row_mask, diagonal_shift = diagonal
    return K * (row_mask[:, None] * row_mask) - torch.diag(diagonal_shift)
