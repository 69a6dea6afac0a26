"""Sparse factorization of large matrices, one design after another: the fill-reducing order belongs to the pattern.

    P A P' = L L'        compiled code: multifrontal, supernodes, products of dense blocks    (`supernodes` of math/products.py)
    P A P' = L L'        CHOLMOD: supernodes, products of dense blocks by BLAS
    P A P' = L D L'      SuperLU in symmetric mode: minimum degree of A + A', no exchange of rows

cvxopt, an optional library, has the order of minimum degree (AMD) for the first two, and CHOLMOD. It has wheels for Linux,
macOS and Windows; scikit-sparse has none, PARDISO runs on Intel processors alone. CHOLMOD serves where there is no compiler.
SuperLU comes with SciPy and serves where cvxopt is not installed.
CHOLMOD as cvxopt has it solves for one column after another, and analyzes a matrix again in each design; L can be read only as
copies of several times its size. Compiled code finds the entries of L once for a pattern, keeps it, and reads it once for up
to sixteen columns: 0.05 s for eight and 0.065 s for fourteen, where L has 26 million entries. Threads share strips of columns.
Processor seconds of one factorization, measured on plates:

    freedoms     compiled code   CHOLMOD   SuperLU
     29,760         0.09          0.24       0.6
    117,120         0.6           1.5        6.3

A mass has the root G = P' L or G = P' L sqrt(D), and G'^-1 X = M^-1 G X.
Tensors are [lane, N, columns] in the order of the degrees of freedom. No autograd inside.
Source: Duff and Reid, ACM TOMS 9 (1983) 302-325 (multifrontal); Liu, SIAM J. Matrix Anal. Appl. 11 (1990) 134-172
(elimination trees). Checked in tests/fem/reduction/test_sparse_factor.py, tests/extensions/native/test_compiled_products.py.
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

from torchmbd.errors import warn
from torchmbd.fem.reduction.forms import Form, IndefiniteLane, Sparse
from torchmbd.math.products import Products, Supernodes, compiled_products
from torchmbd.math.sparse import Pattern

Array = np.ndarray
WHOLE, PERMUTED = 0, 7  # systems of `cholmod.solve`: A x = b, x = P b
SLOW = 20_000  # freedoms from which a warning says that cvxopt is missing


class SparseLayout:
    """The pattern, with its diagonal, and its order, which all matrices of one pattern share.

    order, inverse   as in `Partition`: the degrees of freedom keep their order here
    """

    def __init__(self, pattern: Pattern) -> None:
        self.pattern, self.size = pattern, pattern.size
        self.order = self.inverse = torch.arange(pattern.size)

    def values(self, form: Form, values: Tensor) -> Tensor:
        """Values [lane, nnz] on the pattern of a matrix of values [lane, *entry]."""
        if isinstance(form, Sparse) and form.pattern is self.pattern:
            return values
        if isinstance(form, Sparse):
            key = self.pattern.rows * self.size + self.pattern.cols
            place = torch.searchsorted(key, form.pattern.rows * self.size + form.pattern.cols)
        else:
            place = self.pattern.diagonal
        return values.new_zeros(len(values), self.pattern.nnz).index_copy_(1, place, values)

    def _minimum_degree(self) -> tuple[Any, Any, Array]:
        """The lower triangle as a matrix of cvxopt, its order by minimum degree, and the places of its values."""
        from cvxopt import amd, matrix, spmatrix  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

        cols = self.pattern.indices.astype(np.int64)
        rows = np.repeat(np.arange(self.size), np.diff(self.pattern.indptr))
        upper = np.flatnonzero(cols >= rows)  # the upper triangle by rows is the lower one by columns
        A = spmatrix(1.0, matrix(cols[upper]), matrix(rows[upper]), (self.size, self.size))
        return A, amd.order(A), upper

    @cached_property
    def ordered(self) -> tuple[Any, Any, Array]:
        """All that CHOLMOD needs of a pattern."""
        return self._minimum_degree()

    @cached_property
    def supernodes(self) -> Supernodes:
        """The entries of L, for compiled code."""
        code = _compiled()
        assert code is not None
        order = np.asarray(self._minimum_degree()[1])[:, 0].astype(np.int64)
        return code.supernodes(self.pattern, torch.from_numpy(order))


class Triangle(Protocol):
    """A factorization of one matrix.

    pivot  the smallest pivot relative to the size of the diagonal entry; <= 0 where the matrix is not positive definite
    """

    pivot: float

    def __init__(self, layout: SparseLayout, values: Array) -> None: ...

    def solve(self, X: Array) -> Array:
        """A^-1 X for columns [N, k]."""
        ...

    def root(self) -> csr_array:
        """G with G G' = A; the factorization cannot solve afterwards."""
        ...


class Supernodal(Triangle):
    """L L' by compiled code, with an order by minimum degree."""

    def __init__(self, layout: SparseLayout, values: Array) -> None:
        code = _compiled()
        assert code is not None
        self._code, self._nodes = code, layout.supernodes
        self._L, self.pivot = code.factorize_supernodes(self._nodes, layout.pattern, torch.from_numpy(values))

    def solve(self, X: Array) -> Array:
        return self._code.solve_supernodes(self._nodes, self._L, torch.from_numpy(X)).numpy()

    def root(self) -> csr_array:
        first, below_start, below, start, order = (x.numpy() for x in self._nodes)
        size = len(order)
        last = np.repeat(first[1:], np.diff(first))  # of each column: the end of its supernode
        from_below = np.repeat(below_start[:-1], np.diff(first))
        column = np.repeat(np.arange(size), np.diff(start))
        down = np.arange(start[-1]) - start[column]  # the place of each entry in its column
        inside = last[column] - column
        far = (
            below[np.minimum(from_below[column] + np.maximum(down - inside, 0), max(len(below) - 1, 0))]
            if len(below)
            else 0
        )
        rows = np.where(down < inside, column + down, far)
        return csr_array(csc_array((self._L.numpy(), order[rows], start), shape=(size, size)))


class Cholmod(Triangle):
    """L L' by CHOLMOD, which solves for one column after another."""

    def __init__(self, layout: SparseLayout, values: Array) -> None:
        from cvxopt import cholmod, matrix  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

        pattern, order, lower = layout.ordered
        A = +pattern  # a copy: other threads read the pattern
        A.V = matrix(values[lower])
        self._cholmod, self._matrix, self._factor = cholmod, matrix, cholmod.symbolic(A, order)
        self._size = layout.size
        try:
            cholmod.numeric(A, self._factor)
        except ArithmeticError:  # a pivot is not positive
            self.pivot = -1.0
            return
        squares = np.array(cholmod.diag(self._factor))[:, 0] ** 2
        diagonal = values[layout.pattern.diagonal.numpy()][:, None]
        self.pivot = float((squares / self._solved(diagonal, PERMUTED)[:, 0]).min())

    def _solved(self, X: Array, system: int) -> Array:
        columns = self._matrix(np.asfortranarray(X))
        self._cholmod.solve(self._factor, columns, sys=system)
        return np.asarray(columns)

    def solve(self, X: Array) -> Array:
        return self._solved(X, WHOLE)

    def root(self) -> csr_array:
        order = self._solved(np.arange(self._size, dtype=float)[:, None], PERMUTED)[:, 0].astype(np.int64)
        start, rows, values = (np.asarray(x)[:, 0] for x in self._cholmod.getfactor(self._factor).CCS)
        return csr_array(csc_array((values, order[rows], start), shape=(self._size,) * 2))


class SuperLU(Triangle):
    """L D L' by SuperLU."""

    def __init__(self, layout: SparseLayout, values: Array) -> None:
        pattern = layout.pattern
        diagonal = values[pattern.diagonal.numpy()]
        A = csc_array((values, pattern.indices, pattern.indptr), shape=(layout.size, layout.size))
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


def _compiled() -> Products | None:
    return compiled_products(torch.empty(0, dtype=torch.float64))


@cache
def _has_cvxopt() -> bool:
    return find_spec("cvxopt") is not None


def solves_columns_together() -> bool:
    """Return True if there is compiled code, and cvxopt for the order."""
    return _has_cvxopt() and _compiled() is not None


def library(size: int) -> type[Triangle]:
    """Return the best factorization there is; without cvxopt a warning says what this costs for large bodies."""
    if _has_cvxopt():
        return Cholmod if _compiled() is None else Supernodal
    if size >= SLOW:
        _warn_missing()
    return SuperLU


@cache
def _warn_missing() -> None:
    warn(
        "cvxopt is not installed, so SuperLU factorizes bodies of more than 20,000 degrees of freedom. The results are equal, "
        "but SuperLU takes about ten times as long as compiled code with cvxopt. Try: pip install 'torchmbd[large]'"
    )


class SparseFactor:
    """A^-1 of a batch of matrices, values [lane, nnz] on the pattern of the layout.

    pivot   of each lane, as in `Triangle` [lane]
    """

    def __init__(self, layout: SparseLayout, values: Tensor) -> None:
        kind = library(layout.size)
        self.lanes = [kind(layout, numbers) for numbers in values.numpy()]
        self.pivot = torch.tensor([lane.pivot for lane in self.lanes], dtype=torch.float64)

    def solve(self, X: Tensor) -> Tensor:
        """A^-1 X for columns [lane, N, k]."""
        out = torch.empty_like(X, memory_format=torch.contiguous_format)
        for lane, columns, solution in zip(self.lanes, X.numpy(), out.numpy(), strict=True):
            solution[:] = lane.solve(columns)
        return out


class SparseRoot:
    """G of a sparse mass."""

    def __init__(self, layout: SparseLayout, values: Tensor) -> None:
        self._factor = SparseFactor(layout, values)
        weak = (self._factor.pivot <= 0.0).nonzero()
        if len(weak):
            raise IndefiniteLane(int(weak[0]))
        self._G = [library(layout.size)(layout, numbers).root() for numbers in values.numpy()]

    def lower(self, X: Tensor) -> Tensor:
        """G X."""
        return torch.stack([torch.from_numpy(G @ x) for G, x in zip(self._G, X.numpy(), strict=True)])

    def upper(self, X: Tensor) -> Tensor:
        """G' X."""
        return torch.stack([torch.from_numpy(G.T @ x) for G, x in zip(self._G, X.numpy(), strict=True)])

    def upper_inverse(self, X: Tensor) -> Tensor:
        """G'^-1 X = M^-1 G X."""
        return self._factor.solve(self.lower(X))
