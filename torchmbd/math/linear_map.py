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

from torchmbd.errors import InputError
from torchmbd.math.lane_groups import by_groups
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
        return by_groups(lambda *x: (linear(*x),), *(y.detach() for y in x))[0]

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
        return by_groups(lambda y: tuple(linear.adjoint(y)), y.detach())

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

    start  where the terms of each row begin, with the end [rows + 1]
    terms  index e in x of every term, row by row [terms]
    size   of x
    """

    def __init__(self, start: Int[Tensor, " rows"], terms: Int[Tensor, " terms"], size: int) -> None:
        if max(len(terms), size) >= 2**31:
            raise InputError(
                "terms",
                allowed="must have fewer than 2^31",
                noun="a matrix",
                state=f"is a sum of {len(terms)} of {size} numbers",
            )
        self.start, self.terms, self.size = start.to(torch.int32), terms.to(torch.int32), size

    @classmethod
    def of(cls, rows: Int[Tensor, " terms"], terms: Int[Tensor, " terms"], shape: tuple[int, int]) -> Sums:
        """The map of terms in any order of their rows; shape: numbers of rows and of x."""
        order = torch.argsort(rows, stable=True)
        counts = torch.bincount(rows, minlength=shape[0])
        return cls(torch.nn.functional.pad(counts.cumsum(0), (1, 0)), terms[order], shape[1])

    @property
    def _rows(self) -> Int[Tensor, " terms"]:
        """The row of every term."""
        return torch.repeat_interleave(self.start.diff())

    def __call__(self, *terms: Float[Tensor, "lanes x"]) -> Float[Tensor, "lanes y"]:
        """y of x."""
        (x,) = terms
        if (code := compiled_products(x)) is not None:
            return code.sums(self.start, self.terms, x)
        return x.new_zeros(len(x), len(self.start) - 1).index_add(1, self._rows, x[:, self.terms])

    def adjoint(self, y: Float[Tensor, "lanes y"]) -> tuple[Float[Tensor, "lanes x"]]:
        """The transpose of the map: for every x the sum of the y that contain it."""
        if (code := compiled_products(y)) is not None:
            return (code.transposed_sums(self.start, self.terms, y, self.size),)
        return (y.new_zeros(len(y), self.size).index_add(1, self.terms, y[:, self._rows]),)
