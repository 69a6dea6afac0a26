"""Linear maps of batches with their adjoint, whose derivatives are the map and the adjoint themselves.

    y = L(x_1, x_2, ...),     dy = L(dx_1, dx_2, ...),     (x_1, x_2, ...)' = L*(y')

Forward mode of torch would treat every product with a constant as one of two variables, and multiply zero tangents.
All x and y have one leading axis of lanes; vmap adds lanes.
Differentiable, forward and reverse, any number of times.

One of them is `Sums`, of selected numbers, as in the assembly of matrices of elements:   y_k = sum of x_e over e in row k
Checked in tests/math/test_linear_map.py.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.math.products import compiled_products
from torchmbd.math.vmap import apply_as_lanes


class LinearMap(Protocol):
    """A linear function of tensors, and its adjoint."""

    def __call__(self, *x: Tensor) -> Tensor:
        """y [lanes, ...] of x [lanes, ...]."""
        ...

    def adjoint(self, y: Tensor) -> tuple[Tensor, ...]:
        """x' [lanes, ...] of y': <x', x> = <y', L(x)> for all x."""
        ...


def apply_linear(linear: LinearMap, *x: Tensor) -> Tensor:
    """Return linear(*x)."""
    return _Mapped.apply(linear, *x)  # pyright: ignore[reportReturnType]


class _Mapped(torch.autograd.Function):
    @staticmethod
    def forward(linear: LinearMap, *x: Tensor) -> Tensor:
        return linear(*x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.linear = inputs[0]

    @staticmethod
    def jvp(ctx: Any, _: None, *dx: Tensor) -> Tensor:
        return apply_linear(ctx.linear, *dx)

    @staticmethod
    def backward(ctx: Any, *dy: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_Adjoint.apply(ctx.linear, dy[0])  # pyright: ignore[reportGeneralTypeIssues]

    @staticmethod
    def vmap(info: Any, in_dims: tuple, linear: LinearMap, *x: Tensor) -> tuple[Tensor, int]:
        return apply_as_lanes(partial(apply_linear, linear), info, in_dims[1:], *x, ordered=False)


class _Adjoint(torch.autograd.Function):
    @staticmethod
    def forward(linear: LinearMap, y: Tensor) -> tuple[Tensor, ...]:
        return linear.adjoint(y)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        ctx.linear = inputs[0]

    @staticmethod
    def jvp(ctx: Any, _: None, dy: Tensor) -> Any:
        return _Adjoint.apply(ctx.linear, dy)

    @staticmethod
    def backward(ctx: Any, *dx: Tensor) -> tuple[None, Tensor]:
        return None, apply_linear(ctx.linear, *dx)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, linear: LinearMap, y: Tensor) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        return apply_as_lanes(partial(_Adjoint.apply, linear), info, in_dims[1:], y, ordered=False)


class Sums:
    """The linear map x [lanes, x] -> y [lanes, y].

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
