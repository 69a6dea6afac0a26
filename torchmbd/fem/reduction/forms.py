"""The forms of a symmetric matrix: dense, diagonal, or sparse values on a fixed pattern.

A form holds size and pattern; the numbers are a tensor `values` [..., *entry]. It has the operations that modes and their
derivatives need: multiply columns, the transpose of that with respect to the values (`pair`), the dense matrix; and a check
that names the offending entry.

    multiply(values, X) = A X            [..., N, k]
    pair(Y, X)          = the values of sum_k y_k x_k', so that <pair(Y, X), dA> = sum_k y_k' dA x_k

Checked in tests/fem/reduction/test_modal_basis.py and tests/fem/reduction/test_sparse_modes.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.products import compiled_products
from torchmbd.math.sparse import Pattern, SparseMatrix

SYMMETRY_TOLERANCE = 1e-9


class Indefinite(InputError):
    """A matrix is not positive definite.

    fault   the matrix, its lane and what is wrong, without the row
    row     the row of the matrix that moves most where its quadratic form is least
    """

    def __init__(self, name: str, lane: str, fault: str, row: int) -> None:
        allowed, state = "positive definite", f"{fault}, and row {row} moves most"
        super().__init__(name, allowed=allowed, noun=f"{name}{lane}", state=state)
        self.fault, self.row = f"{name}{lane} {fault}", row


#: The fault of a mass.
NO_INERTIA = "lets something move without inertia, or against it"


class IndefiniteLane(Exception):
    """The factorization of a lane breaks down."""

    def __init__(self, lane: int):
        super().__init__(lane)
        self.lane = lane


@dataclass(frozen=True)
class Dense:
    """values [..., N, N]."""

    size: int
    entry_dims = 2

    def multiply(self, values: Tensor, X: Tensor) -> Tensor:
        return values @ X

    def pair(self, Y: Tensor, X: Tensor) -> Tensor:
        return Y @ X.mT

    def dense(self, values: Tensor) -> Tensor:
        return values

    def diagonal(self, values: Tensor) -> Tensor:
        return values.diagonal(dim1=-2, dim2=-1)

    def transposed(self, values: Tensor) -> Tensor:
        return values.mT

    def entry(self, index: tuple[int, ...]) -> str:
        return f"[{index[0]}, {index[1]}]"


@dataclass(frozen=True)
class Diagonal:
    """values [..., N]."""

    size: int
    entry_dims = 1

    def multiply(self, values: Tensor, X: Tensor) -> Tensor:
        return values[..., None] * X

    def pair(self, Y: Tensor, X: Tensor) -> Tensor:
        return (Y * X).sum(-1)

    def dense(self, values: Tensor) -> Tensor:
        return torch.diag_embed(values)

    def diagonal(self, values: Tensor) -> Tensor:
        return values

    def transposed(self, values: Tensor) -> Tensor:
        return values

    def entry(self, index: tuple[int, ...]) -> str:
        return f"[{index[0]}, {index[0]}]"


@dataclass(frozen=True)
class Sparse:
    """values [..., nnz] on a pattern; symmetric: known to be."""

    pattern: Pattern
    symmetric: bool = False
    entry_dims = 1

    @property
    def size(self) -> int:
        return self.pattern.size

    def multiply(self, values: Tensor, X: Tensor) -> Tensor:
        if values.dim() == 3 and X.shape[:2] == (len(values), 1) and (code := compiled_products(X)) is not None:
            return code.multiply_sparse(self.pattern, values, X[:, 0])
        lanes = np.broadcast_shapes(values.shape[:-1], X.shape[:-2])
        flat_values = values.expand(*lanes, -1).reshape(-1, self.pattern.nnz).numpy()
        flat_X = X.expand(*lanes, *X.shape[-2:]).reshape(-1, *X.shape[-2:]).numpy()
        result = np.empty_like(flat_X)
        for product, numbers, columns in zip(result, flat_values, flat_X, strict=True):
            matrix = csr_array((numbers, self.pattern.indices, self.pattern.indptr), shape=(self.size,) * 2)
            product[:] = matrix @ columns  # ten times faster than index_add
        return torch.from_numpy(result).reshape(*lanes, *X.shape[-2:])

    def pair(self, Y: Tensor, X: Tensor) -> Tensor:
        if X.dim() == 4 and X.shape[:2] == (len(Y), 1) and (code := compiled_products(X)) is not None:
            return code.products_at_pattern(self.pattern, Y, X[:, 0])
        lanes = np.broadcast_shapes(Y.shape[:-2], X.shape[:-2])
        total = Y.new_zeros((*lanes, self.pattern.nnz))
        rows, cols = self.pattern.rows, self.pattern.cols
        for y, x in zip(Y.unbind(-1), X.unbind(-1), strict=True):
            total += y[..., rows] * x[..., cols]
        return total

    def dense(self, values: Tensor) -> Tensor:
        return SparseMatrix(self.pattern, values).dense()

    def diagonal(self, values: Tensor) -> Tensor:
        on = self.pattern.diagonal
        zeros = values.new_zeros((*values.shape[:-1], self.size))
        return zeros.index_add(-1, self.pattern.column[on], values[..., on])

    def transposed(self, values: Tensor) -> Tensor:
        return values[..., self.pattern.transposed]

    def entry(self, index: tuple[int, ...]) -> str:
        return f"[{int(self.pattern.rows[index[0]])}, {int(self.pattern.cols[index[0]])}]"


Form = Dense | Diagonal | Sparse


def recognize(name: str, matrix: Tensor | SparseMatrix, size: int | None = None) -> tuple[Form, Tensor]:
    """Split a matrix into its form and its values. With `size` given, a tensor [..., size] is a diagonal."""
    if isinstance(matrix, SparseMatrix):
        form: Form = Sparse(matrix.pattern, matrix.symmetric)
        values = matrix.values
    elif not isinstance(matrix, Tensor):
        raise InputError(name, matrix, "a tensor or a SparseMatrix", state=f"is a {type(matrix).__name__}")
    elif matrix.dim() >= 2 and matrix.shape[-1] == matrix.shape[-2] and (size is None or matrix.shape[-1] == size):
        form, values = Dense(matrix.shape[-1]), matrix
    elif size is not None and matrix.dim() >= 1 and matrix.shape[-1] == size:
        form, values = Diagonal(size), matrix
    else:
        diagonal = "" if size is None else f" or [..., {size}] (a diagonal)"
        needed = "[..., N, N]" if size is None else f"[..., {size}, {size}]"
        allowed, state = f"must have shape {needed}{diagonal}, or be a SparseMatrix", f"has shape {tuple(matrix.shape)}"
        raise InputError(name, allowed=allowed, state=state)
    if size is not None and form.size != size:
        raise InputError(name, allowed=f"must have {size}, the number of rows of K", state=f"has {form.size} rows")
    if values.dtype != torch.float64:
        raise InputError(name, allowed="must have dtype torch.float64", state=f"has dtype {values.dtype}")
    return form, values


def check(name: str, form: Form, values: Tensor) -> None:
    """Raise InputError naming lane and entry where a matrix [lane, *entry] is not finite or not symmetric."""
    if not torch.isfinite(values.sum()) and (wrong := ~torch.isfinite(values)).any():
        raise InputError(
            name,
            values[wrong][0].item(),
            "finite numbers",
            noun=_entry_name(name, form, wrong),
        )
    if isinstance(form, Sparse) and form.symmetric:
        return
    skew = (values - form.transposed(values)).abs()
    scale = values.abs().amax(dim=tuple(range(1, values.dim())), keepdim=True)
    wrong = skew > SYMMETRY_TOLERANCE * scale
    if wrong.any():
        difference = skew[wrong][0].item()
        raise InputError(
            name,
            allowed="a symmetric matrix",
            state=f"differs by {difference:.3g} from its mirror image",
            noun=_entry_name(name, form, wrong),
        )


def check_positive_diagonal(form: Form, values: Tensor) -> None:
    """Raise InputError if a diagonal entry of M is not positive: it cannot be positive definite then."""
    diagonal = form.diagonal(values)
    wrong = diagonal <= 0
    if wrong.any():
        lane, row = (int(i) for i in wrong.nonzero()[0])
        value = diagonal[lane, row].item()
        place = f"M[{row}, {row}]{lane_name(lane, len(values))}"
        raise InputError("M", value, "positive, because M is positive definite", noun=place, shown=f"{value:.3g}")


def lane_name(lane: int, lanes: int) -> str:
    return f" of lane {lane}" if lanes > 1 else ""


def _entry_name(name: str, form: Form, wrong: Tensor) -> str:
    lane, *index = (int(i) for i in wrong.nonzero()[0])
    return f"{name}{form.entry(tuple(index))}{lane_name(lane, len(wrong))}"
