"""Linear maps of batches with their adjoint, whose derivatives are the map and the adjoint themselves.

    y = L(x_1, x_2, ...),     dy = L(dx_1, dx_2, ...),     (x_1, x_2, ...)' = L*(y')

Forward mode of torch would treat every product with a constant as one of two variables, and multiply zero tangents.
All x and y have one leading axis of lanes; vmap adds lanes.
Differentiable, forward and reverse, any number of times.
Checked in tests/math/test_linear_map.py.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

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
        return apply_as_lanes(partial(apply_linear, linear), info, in_dims[1:], *x)


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
        return apply_as_lanes(partial(_Adjoint.apply, linear), info, in_dims[1:], y)
