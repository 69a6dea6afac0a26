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
        raise InputError(f"{name}[{k}] = {int(index[k])} is outside of 0 ... {size - 1}")
    return index


@dataclass(frozen=True, eq=False)
class Pattern:
    """The entries of a square symmetric matrix of `size` rows that may differ from zero; see the module header.

    Raises InputError where coordinates are out of range, unsorted, repeated or without their mirror image.
    """

    rows: Tensor
    cols: Tensor
    size: int

    def __post_init__(self) -> None:
        rows, cols = _indices("rows", self.rows, self.size), _indices("cols", self.cols, self.size)
        if len(rows) != len(cols):
            raise InputError(f"rows and cols have {len(rows)} and {len(cols)} entries; equally many are needed")
        key = rows * self.size + cols
        if (key[1:] <= key[:-1]).any():
            k = int((key[1:] <= key[:-1]).nonzero()[0]) + 1
            entry = (int(rows[k]), int(cols[k]))
            raise InputError(f"coordinate {k} {entry} repeats or precedes its forerunner; use Pattern.gather to sort")
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "cols", cols)
        mirrored = (rows[self.transposed] == cols) & (cols[self.transposed] == rows)
        if not mirrored.all():
            missing = ~torch.isin(cols * self.size + rows, key, assume_unique=True)
            k = int(missing.nonzero()[0])
            raise InputError(f"entry ({int(rows[k])}, {int(cols[k])}) has no mirror image; store both triangles")

    @classmethod
    def unchecked(cls, rows: Tensor, cols: Tensor, size: int) -> Pattern:
        """A pattern of coordinates that are sorted, unique and symmetric by their construction; the checks take longer."""
        pattern = object.__new__(cls)
        for name, value in (("rows", rows), ("cols", cols), ("size", size)):
            object.__setattr__(pattern, name, value)
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
        return len(self.rows)

    @cached_property
    def indptr(self) -> np.ndarray:
        """Where each row starts among the values, numpy int32 [size + 1]; by symmetry each column, too."""
        counts = np.bincount(self.rows.numpy(), minlength=self.size)
        return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)

    @cached_property
    def indices(self) -> np.ndarray:
        """The column of each value, numpy int32 [nnz]."""
        return self.cols.numpy().astype(np.int32)

    @cached_property
    def transposed(self) -> Tensor:
        """For each value the position of its mirror image [nnz]: the values in the order of columns."""
        return torch.argsort(self.cols, stable=True)

    def restrict(self, keep: ArrayLike | Tensor) -> tuple[Pattern, Tensor]:
        """Keep rows and columns `keep`, in that order: the smaller pattern, and the positions of its values.

        `values[..., positions]` are the values of the submatrix. A permutation of all rows is a renumbering.
        """
        kept = _indices("keep", keep, self.size)
        row_of = torch.full((self.size,), -1, dtype=torch.long)
        row_of[kept] = torch.arange(len(kept))
        if int((row_of >= 0).sum()) != len(kept):
            raise InputError("keep names a row more than once; each at most once is allowed")
        rows, cols = row_of[self.rows], row_of[self.cols]
        positions = ((rows >= 0) & (cols >= 0)).nonzero().squeeze(-1)
        if (kept[1:] < kept[:-1]).any():
            positions = positions[torch.argsort(rows[positions] * len(kept) + cols[positions])]
        return Pattern.unchecked(rows[positions], cols[positions], len(kept)), positions

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
            raise InputError(f"values have shape {tuple(self.values.shape)}; [..., {self.pattern.nnz}] is needed")

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
            raise InputError(f"right factor has shape {tuple(other.shape)}; [..., {self.pattern.size}, k] is needed")
        products = self.values[..., :, None] * other[..., self.pattern.cols, :]
        result = products.new_zeros((*products.shape[:-2], self.pattern.size, products.shape[-1]))
        return result.index_add(-2, self.pattern.rows, products)
