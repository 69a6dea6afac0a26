"""A square symmetric matrix with a fixed pattern: the coordinates once, the values for every design.

    K[rows[e], cols[e]] = values[..., e],      e = 0 ... nnz - 1

rows, cols   sorted row-major, unique, both triangles stored        [nnz]
values       one row of numbers for each design (leading lanes)     [..., nnz]

A mesh has one pattern. Only `values` depend on the design, so a batch of designs, its tangents and its cotangents are tensors
of the last dimension nnz.
Differentiable, forward and reverse, in the values (and in the right factor of `@`).
Checked in tests/math/test_sparse.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from torchmbd.errors import InputError


def _indices(name: str, indices: ArrayLike | Tensor, size: int) -> Tensor:
    index = torch.as_tensor(np.asarray(indices), dtype=torch.long).flatten()
    outside = (index < 0) | (index >= size)
    if outside.any():
        k = int(outside.nonzero()[0])
        raise InputError(
            (name, k),
            int(index[k]),
            f"0 to {size - 1}",
            noun=f"{name}[{k}]",
        )
    return index


class Pattern:
    """The entries of a square symmetric matrix of `size` rows that may differ from zero; see the module header.

    start   where each row begins among the values, with the end, int32 [size + 1]; by symmetry each column, too
    column  of each value, int32 [nnz]

    Raises InputError if coordinates are out of range, unsorted, repeated or without their mirror image, and where there
    are 2^31 of them or more.
    """

    def __init__(self, rows: Tensor, cols: Tensor, size: int) -> None:
        i, j = _indices("rows", rows, size), _indices("cols", cols, size)
        if len(i) != len(j):
            raise InputError(
                "cols",
                allowed="must have the same number of both",
                state=f"have {len(i)} and {len(j)} entries",
                noun="rows and cols",
            )
        key = i * size + j
        if (key[1:] <= key[:-1]).any():
            k = int((key[1:] <= key[:-1]).nonzero()[0]) + 1
            entry = (int(i[k]), int(j[k]))
            raise InputError(
                ("rows", k),
                noun=f"coordinate {k} {entry}",
                allowed="in ascending order, each once",
                hint="Pattern.gather, which sorts the entries",
                state="repeats the entry before it, or belongs before it",
            )
        self._set(torch.nn.functional.pad(torch.bincount(i, minlength=size).cumsum(0), (1, 0)), j, size)
        mirror = self.transposed
        if not ((i[mirror] == j) & (j[mirror] == i)).all():
            missing = ~torch.isin(j * size + i, key, assume_unique=True)
            k = int(missing.nonzero()[0])
            raise InputError(
                ("rows", k),
                hint="store both triangles of the matrix",
                noun=f"entry ({int(i[k])}, {int(j[k])})",
                state="does not have a counterpart in the other triangle",
            )

    def _set(self, start: Tensor, column: Tensor, size: int) -> None:
        if max(len(column), size) >= 2**31:
            raise InputError(
                "rows",
                allowed="must have fewer than 2^31 of both",
                noun="a matrix",
                state=f"has {size} rows and {len(column)} entries",
            )
        self.start, self.column, self.size = start.to(torch.int32), column.to(torch.int32), size

    @classmethod
    def unchecked(cls, start: Tensor, column: Tensor, size: int) -> Pattern:
        """A pattern of sorted, unique and symmetric entries by their construction; the checks take longer."""
        pattern = object.__new__(cls)
        pattern._set(start, column, size)
        return pattern

    @staticmethod
    def gather(rows: ArrayLike | Tensor, cols: ArrayLike | Tensor, size: int) -> tuple[Pattern, Tensor]:
        """Sort and merge any coordinates: the pattern, and for each given coordinate its position among the values.

        An assembly is then `values = zeros(nnz).index_add(0, position, contributions)`.
        """
        key = _indices("rows", rows, size) * size + _indices("cols", cols, size)
        unique, position = torch.unique(key, sorted=True, return_inverse=True)
        return Pattern(torch.div(unique, size, rounding_mode="floor"), unique % size, size), position

    @property
    def nnz(self) -> int:
        return len(self.column)

    @property
    def rows(self) -> Tensor:
        """The row of each value [nnz], made anew."""
        return torch.repeat_interleave(self.start.diff().long())

    @property
    def cols(self) -> Tensor:
        """The column of each value [nnz], made anew."""
        return self.column.long()

    @cached_property
    def indptr(self) -> np.ndarray:
        """`start` for NumPy and SciPy."""
        return self.start.numpy()

    @cached_property
    def indices(self) -> np.ndarray:
        """`column` for NumPy and SciPy."""
        return self.column.numpy()

    @cached_property
    def diagonal(self) -> Tensor:
        """The positions of the values on the diagonal, as many as there are."""
        return (self.rows == self.column).nonzero().squeeze(-1)

    @cached_property
    def transposed(self) -> Tensor:
        """For each value the position of its mirror image [nnz]: the values in the order of columns."""
        return torch.argsort(self.column, stable=True)

    def restrict(self, keep: ArrayLike | Tensor) -> tuple[Pattern, Tensor]:
        """Keep rows and columns `keep`, in that order: the smaller pattern, and the positions of its values.

        `values[..., positions]` are the values of the submatrix. A permutation of all rows is a renumbering.
        """
        kept = _indices("keep", keep, self.size)
        row_of = torch.full((self.size,), -1, dtype=torch.long)
        row_of[kept] = torch.arange(len(kept))
        if int((row_of >= 0).sum()) != len(kept):
            raise InputError("keep", allowed="must name each row at most once", state="names a row more than once")
        column = row_of.to(torch.int32)[self.column]
        counted = (column >= 0) & torch.repeat_interleave(row_of >= 0, self.start.diff())
        positions = counted.nonzero().squeeze(-1)
        before = torch.nn.functional.pad(counted.cumsum(0, dtype=torch.int32), (1, 0))  # in all values before each
        counts = before[self.start].diff()[kept]
        if (kept[1:] < kept[:-1]).any():
            rows = row_of[self.rows[positions]]
            positions = positions[torch.argsort(rows * len(kept) + column[positions])]
        start = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
        return Pattern.unchecked(start, column[positions], len(kept)), positions.to(torch.int32)

    def to_scipy(self, values: Tensor | np.ndarray) -> scipy.sparse.csc_array:
        """One design's values [nnz] as a SciPy matrix (both triangles)."""
        numbers = values.detach().numpy() if isinstance(values, Tensor) else np.asarray(values)
        shape = (self.size, self.size)
        # csr of the transpose = csc; the pattern is symmetric but the values may be not, so take the mirror image
        return scipy.sparse.csc_array((numbers[self.transposed.numpy()], self.indices, self.indptr), shape=shape)


@dataclass(frozen=True, eq=False)
class SparseMatrix:
    """Values [..., nnz] on a pattern: one matrix for each lane.  Raises InputError when their number is wrong.

    symmetric  whether the values are known to be symmetric
    """

    pattern: Pattern
    values: Float[Tensor, "*lanes nnz"]
    symmetric: bool = False

    def __post_init__(self) -> None:
        if self.values.shape[-1:] != (self.pattern.nnz,):
            raise InputError(
                "values",
                allowed=f"must have shape [..., {self.pattern.nnz}]",
                state=f"have shape {tuple(self.values.shape)}",
            )

    @property
    def size(self) -> int:
        return self.pattern.size

    @property
    def lanes(self) -> torch.Size:
        return self.values.shape[:-1]

    def restrict(self, keep: ArrayLike | Tensor) -> SparseMatrix:
        """Keep rows and columns `keep`, in that order."""
        pattern, positions = self.pattern.restrict(keep)
        return SparseMatrix(pattern, self.values[..., positions], self.symmetric)

    def dense(self) -> Float[Tensor, "*lanes n n"]:
        """All size x size numbers."""
        n = self.pattern.size
        flat = self.values.new_zeros((*self.lanes, n * n))
        k = self.pattern.rows * n + self.pattern.cols
        return flat.index_add(-1, k, self.values).reshape(*self.lanes, n, n)

    def __matmul__(self, other: Tensor) -> Tensor:
        """Multiply a vector [n] or columns [..., n, k]; lanes broadcast."""
        if other.dim() == 1:
            return (self @ other[:, None]).squeeze(-1)
        if other.shape[-2] != self.pattern.size:
            raise InputError(
                "other",
                allowed=f"must have shape [..., {self.pattern.size}, k]",
                state=f"has shape {tuple(other.shape)}",
                noun="right factor",
            )
        products = self.values[..., :, None] * other[..., self.pattern.cols, :]
        result = products.new_zeros((*products.shape[:-2], self.pattern.size, products.shape[-1]))
        return result.index_add(-2, self.pattern.rows, products)
