"""Sums of chosen numbers: what an assembly makes of the numbers of its elements.

    y_k = sum of x_e over e in row k

Checked in tests/math/test_sums.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.math.compiled_products import compiled_products


class Sums:
    """A linear map (linear_map.py) of lanes.

    rows   the row of every term, sorted [terms];  terms   which x it is [terms]
    shape  how many y and x there are
    """

    def __init__(self, rows: Int[Tensor, " terms"], terms: Int[Tensor, " terms"], shape: tuple[int, int]) -> None:
        self.rows, self.terms, self.shape = rows, terms, shape
        self.start = torch.nn.functional.pad(torch.bincount(rows, minlength=shape[0]).cumsum(0), (1, 0))

    @classmethod
    def of(cls, rows: Int[Tensor, " terms"], terms: Int[Tensor, " terms"], shape: tuple[int, int]) -> Sums:
        """From rows in any order."""
        order = torch.argsort(rows, stable=True)
        return cls(rows[order], terms[order], shape)

    def chosen(self, rows: Int[Tensor, " k"]) -> Sums:
        """Only these rows, in this order, which may come again."""
        count = self.start.diff()[rows]
        row = torch.repeat_interleave(count)
        within = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
        return Sums(row, self.terms[self.start[rows][row] + within], (len(rows), self.shape[1]))

    def __call__(self, x: Float[Tensor, "lanes x"]) -> Float[Tensor, "lanes y"]:
        """y of x."""
        if (code := compiled_products(x)) is not None:
            return code.sums(self.start, self.terms, x)
        return x.new_zeros(len(x), self.shape[0]).index_add(1, self.rows, x[:, self.terms])

    def adjoint(self, y: Float[Tensor, "lanes y"]) -> Float[Tensor, "lanes x"]:
        """Of every x the sum over the y that it is in."""
        if (code := compiled_products(y)) is not None:
            return code.shares(self.start, self.terms, y, self.shape[1])
        return y.new_zeros(len(y), self.shape[1]).index_add(1, self.terms, y[:, self.rows])
