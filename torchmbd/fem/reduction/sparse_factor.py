"""Sparse factorization of large matrices, one design after another: the fill-reducing order belongs to the pattern.

    P A P' = L L'        CHOLMOD: minimum degree (AMD), supernodes, products of dense blocks by BLAS
    P A P' = L D L'      SuperLU in symmetric mode: minimum degree of A + A', no exchange of rows

CHOLMOD comes with cvxopt, an optional library: it has wheels for Linux, macOS and Windows, and keeps the order of a pattern for
further matrices. scikit-sparse has no wheels, PARDISO runs on Intel processors alone. SuperLU comes with SciPy and serves where
cvxopt is not installed. On one core, CHOLMOD factorizes a plate of 29,760 freedoms in 0.15 s and one of 117,120 in 0.9 s,
SuperLU in 0.6 s and 6.3 s. Both solve for one column after another, each in about 2 ns per entry of L; SuperLU stores L and U.
Compiled code takes L from CHOLMOD, in half the time of the factorization, and solves for eight columns in the time of one and a
half (`solve_supernodes` of math/products.py). Threads share the columns.
A mass has the root G = P' L or G = P' L sqrt(D), and G'^-1 X = M^-1 G X.
Tensors are [lane, N, columns] in the order of the freedoms. No autograd inside.
Checked in tests/fem/reduction/test_sparse_factor.py.
"""

from __future__ import annotations

from functools import cache, cached_property
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
import torch
from scipy.sparse import csc_array, csr_array, dia_array
from scipy.sparse.linalg import splu
from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.fem.reduction.forms import Form, Sparse, lane_name
from torchmbd.math.products import Supernodes, compiled_products
from torchmbd.math.sparse import Pattern

Array = np.ndarray
WHOLE, PERMUTED = 0, 7  # systems of `cholmod.solve`: A x = b, x = P b
SLOW = 20_000  # freedoms from which a warning says that CHOLMOD is missing


class SparseLayout:
    """The lower triangle by columns, and its order, which all matrices of one pattern share.

    order, inverse   as of `Partition`: the freedoms keep their order here
    """

    def __init__(self, pattern: Pattern) -> None:
        rows, cols = pattern.rows.numpy(), pattern.cols.numpy()
        self.pattern, self.size = pattern, pattern.size
        self.order = self.inverse = torch.arange(pattern.size)
        upper = cols >= rows
        self.rows, self.cols = cols[upper], rows[upper]  # the upper triangle by rows is the lower one by columns
        self.start = np.concatenate([[0], np.cumsum(np.bincount(self.cols, minlength=self.size))])
        self.diagonal = (self.rows == self.cols).nonzero()[0]

    def lower(self, form: Form, values: Tensor) -> Array:
        """The lower triangle by columns [lane, entry] of a matrix of values [lane, *entry]."""
        numbers = values.numpy()
        lower = np.zeros((len(numbers), len(self.rows)))
        if not isinstance(form, Sparse):
            lower[:, self.diagonal] = numbers
        elif form.pattern is self.pattern:
            np.compress(self.pattern.cols.numpy() >= self.pattern.rows.numpy(), numbers, axis=1, out=lower)
        else:
            rows, cols = form.pattern.rows.numpy(), form.pattern.cols.numpy()
            upper = cols >= rows
            key, part = self.cols * self.size + self.rows, rows[upper] * self.size + cols[upper]
            lower[:, np.searchsorted(key, part)] = numbers[:, upper]
        return lower

    @cached_property
    def ordered(self) -> tuple[Any, Any]:
        """The pattern as a matrix of cvxopt, and its order by minimum degree."""
        from cvxopt import amd, matrix, spmatrix  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

        A = spmatrix(1.0, *(matrix(x.astype(np.int64)) for x in (self.rows, self.cols)), (self.size, self.size))
        return A, amd.order(A)


class Triangle(Protocol):
    """A factorization of one matrix.

    pivot   the smallest pivot relative to the size of the diagonal entry; <= 0 where the matrix is not positive definite
    """

    pivot: float

    def __init__(self, layout: SparseLayout, lower: Array) -> None: ...

    def solve(self, X: Array) -> Array:
        """A^-1 X for columns [N, k]."""
        ...

    def root(self) -> csr_array:
        """G with G G' = A; the factorization cannot solve afterwards."""
        ...


class Cholmod(Triangle):
    """L L' by CHOLMOD, which solves for one column after another; compiled code solves for several by the same L."""

    _supernodes: Supernodes | None = None

    def __init__(self, layout: SparseLayout, lower: Array) -> None:
        from cvxopt import cholmod, matrix  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

        pattern, order = layout.ordered
        A = +pattern  # a copy: other threads read the pattern
        A.V = matrix(lower)
        self._cholmod, self._matrix, self._factor = cholmod, matrix, cholmod.symbolic(A, order)
        self._size = layout.size
        try:
            cholmod.numeric(A, self._factor)
        except ArithmeticError:  # a pivot is not positive
            self.pivot = -1.0
            return
        squares = np.array(cholmod.diag(self._factor))[:, 0] ** 2
        self.pivot = float((squares / self._solved(lower[layout.diagonal][:, None], PERMUTED)[:, 0]).min())

    def _solved(self, X: Array, system: int) -> Array:
        columns = self._matrix(np.asfortranarray(X))
        self._cholmod.solve(self._factor, columns, sys=system)
        return np.asarray(columns)

    def _columns(self) -> tuple[Array, Array, Array, Array]:
        """Return the starts [N + 1] of the columns of L, their rows and values, and the order; free CHOLMOD's factor."""
        order = self._solved(np.arange(self._size, dtype=float)[:, None], PERMUTED)[:, 0].astype(np.int64)
        start, rows, values = (np.asarray(x)[:, 0] for x in self._cholmod.getfactor(self._factor).CCS)
        del self._factor  # as large as L
        return start, rows, values, order

    def solve(self, X: Array) -> Array:
        if (code := compiled_products(torch.empty(0, dtype=torch.float64))) is None:
            return self._solved(X, WHOLE)
        if self._supernodes is None:
            self._supernodes = supernodes(*self._columns())
        return code.solve_supernodes(self._supernodes, torch.from_numpy(X)).numpy()

    def root(self) -> csr_array:
        start, rows, values, order = self._columns()
        return csr_array(csc_array((values, order[rows], start), shape=(self._size,) * 2))


def supernodes(start: Array, rows: Array, values: Array, order: Array) -> Supernodes:
    """Return the factor of columns that begin at `start` [N + 1], with their rows and values [entries] down the column.

    The rows of a column are among those of its parent, the column of its first entry below the diagonal. So a column and the
    next one, its parent with one entry less, have the same rows.
    """
    count = np.diff(start)
    alike = count[:-1] == count[1:] + 1
    alike[alike] = rows[start[:-2][alike] + 1] == alike.nonzero()[0] + 1
    first = np.concatenate([[0], (~alike).nonzero()[0] + 1, [len(count)]])
    width = np.diff(first)
    below_count = count[first[:-1]] - width
    below_start = np.concatenate([[0], below_count.cumsum()])
    places = np.arange(below_start[-1]) + np.repeat(start[first[:-1]] + width - below_start[:-1], below_count)
    return Supernodes(*map(torch.from_numpy, (first, below_start, rows[places], start, values, order)))


class SuperLU(Triangle):
    """L D L' by SuperLU."""

    def __init__(self, layout: SparseLayout, lower: Array) -> None:
        L = csc_array((lower, layout.rows, layout.start), shape=(layout.size, layout.size))
        diagonal = lower[layout.diagonal]
        A = csc_array(L + L.T - dia_array((diagonal[None], 0), shape=L.shape))
        options = {"SymmetricMode": True, "Equil": False}
        self.pivot = -1.0
        try:
            self._factor = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError as error:
            if "singular" not in str(error):
                raise
            return
        if np.array_equal(self._factor.perm_r, self._factor.perm_c):  # else a pivot of the diagonal was zero
            self._pivots = self._factor.U.diagonal()
            self.pivot = float((self._pivots[self._factor.perm_c] / np.abs(diagonal)).min())

    def solve(self, X: Array) -> Array:
        return self._factor.solve(X)

    def root(self) -> csr_array:
        scale = dia_array((np.sqrt(self._pivots)[None], 0), shape=self._factor.L.shape)
        return csr_array(self._factor.L @ scale)[self._factor.perm_r]


def solves_columns_together() -> bool:
    """Return True if CHOLMOD is installed and compiled code can take its L."""
    return find_spec("cvxopt") is not None and compiled_products(torch.empty(0, dtype=torch.float64)) is not None


def library(size: int) -> type[Triangle]:
    """Return CHOLMOD, or SuperLU if cvxopt is not installed; a warning then says what this costs for large bodies."""
    if find_spec("cvxopt") is not None:
        return Cholmod
    if size >= SLOW:
        _warn_missing()
    return SuperLU


@cache
def _warn_missing() -> None:
    warn(
        "cvxopt is not installed: SuperLU factorizes bodies of more than 20,000 freedoms in about five times the time and "
        "twice the memory of CHOLMOD; results are equal. Try: pip install 'torchmbd[large]'"
    )


class SparseFactor:
    """A^-1 of a batch of matrices, their lower triangles [lane, entry].

    pivot   of each lane, as of `Triangle` [lane]
    """

    def __init__(self, layout: SparseLayout, lower: Array) -> None:
        kind = library(layout.size)
        self.lanes = [kind(layout, numbers) for numbers in lower]
        self.pivot = torch.tensor([lane.pivot for lane in self.lanes], dtype=torch.float64)

    def solve(self, X: Tensor) -> Tensor:
        """A^-1 X for columns [lane, N, k]."""
        out = torch.empty_like(X, memory_format=torch.contiguous_format)
        for lane, columns, solution in zip(self.lanes, X.numpy(), out.numpy(), strict=True):
            solution[:] = lane.solve(columns)
        return out


class SparseRoot:
    """G of a sparse mass."""

    def __init__(self, layout: SparseLayout, lower: Array) -> None:
        self._factor = SparseFactor(layout, lower)
        weak = (self._factor.pivot <= 0.0).nonzero()
        if len(weak):
            raise InputError(f"M{lane_name(int(weak[0]), len(lower))} is not positive definite")
        self._G = [library(layout.size)(layout, numbers).root() for numbers in lower]

    def lower(self, X: Tensor) -> Tensor:
        """G X."""
        return torch.stack([torch.from_numpy(G @ x) for G, x in zip(self._G, X.numpy(), strict=True)])

    def upper(self, X: Tensor) -> Tensor:
        """G' X."""
        return torch.stack([torch.from_numpy(G.T @ x) for G, x in zip(self._G, X.numpy(), strict=True)])

    def upper_inverse(self, X: Tensor) -> Tensor:
        """G'^-1 X = M^-1 G X."""
        return self._factor.solve(self.lower(X))
