"""Sums of selected numbers, as in the assembly of matrices of elements.

    y_k = sum of x_e over e in row k

Checked in tests/math/test_sums.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.math.products import compiled_products


class Sums:
    """The linear map (linear_map.py) x [lanes, x] -> y [lanes, y].

    rows   row k of every term, sorted [terms];  terms   its index e in x [terms]
    shape  numbers of rows and of x
    """

    def __init__(self, rows: Int[Tensor, " terms"], terms: Int[Tensor, " terms"], shape: tuple[int, int]) -> None:
        self.rows, self.terms, self.shape = rows, terms, shape
        self.start = torch.nn.functional.pad(torch.bincount(rows, minlength=shape[0]).cumsum(0), (1, 0))

    @classmethod
    def of(cls, rows: Int[Tensor, " terms"], terms: Int[Tensor, " terms"], shape: tuple[int, int]) -> Sums:
        """The map of terms in any order of their rows."""
        order = torch.argsort(rows, stable=True)
        return cls(rows[order], terms[order], shape)

    def selected(self, rows: Int[Tensor, " k"]) -> Sums:
        """The map to some of the rows, in this order; a row may occur several times."""
        count = self.start.diff()[rows]
        row = torch.repeat_interleave(count)
        within = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
        return Sums(row, self.terms[self.start[rows][row] + within], (len(rows), self.shape[1]))

    def __call__(self, *terms: Float[Tensor, "lanes x"]) -> Float[Tensor, "lanes y"]:
        """y of x."""
        (x,) = terms
        if (code := compiled_products(x)) is not None:
            return code.sums(self.start, self.terms, x)
        return x.new_zeros(len(x), self.shape[0]).index_add(1, self.rows, x[:, self.terms])

    def adjoint(self, y: Float[Tensor, "lanes y"]) -> tuple[Float[Tensor, "lanes x"]]:
        """The transpose of the map: for every x the sum of the y that contain it."""
        if (code := compiled_products(y)) is not None:
            return (code.transposed_sums(self.start, self.terms, y, self.shape[1]),)
        return (y.new_zeros(len(y), self.shape[1]).index_add(1, self.terms, y[:, self.rows]),)
