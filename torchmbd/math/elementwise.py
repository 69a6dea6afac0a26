"""Functions of numbers, plain or with tangents (pair.py), that work on each entry alone.

    f([x, dx]) = [f(x), f'(x) dx]

Checked in tests/math/test_pair.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.pair import Pair, value


def function(f: Callable[[Tensor], Tensor], df: Callable[[Tensor], Tensor], x: Any) -> Any:
    """Apply a scalar function, elementwise, given with its derivative."""
    if isinstance(x, Pair):
        return Pair.of(f(x.value), df(x.value) * x.tangent)
    return f(x)


def sin(x: Any) -> Any:
    return function(torch.sin, torch.cos, x)


def cos(x: Any) -> Any:
    return function(torch.cos, lambda y: -torch.sin(y), x)


def sqrt(x: Any) -> Any:
    return function(torch.sqrt, lambda y: 0.5 * torch.rsqrt(y), x)


def partial_derivatives(f: Callable[..., Tensor], *xs: Tensor) -> list[Tensor]:
    """Partial derivatives of an elementwise function by each of its arguments."""
    result = []
    for k, x in enumerate(xs):
        moved: Any = torch.func.jvp(lambda y, k=k: f(*xs[:k], y, *xs[k + 1 :]), (x,), (torch.ones_like(x),))
        result.append(moved[1])
    return result


def apply_elementwise(f: Callable[..., Tensor], *xs: Any) -> Any:
    """Apply an elementwise function of several numbers; its derivatives come from forward mode, in reverse mode as well."""
    paired = [k for k, x in enumerate(xs) if isinstance(x, Pair)]
    values = [value(x) for x in xs]
    if not paired:
        return _InReverse.apply(f, *values) if any(x.requires_grad for x in values) else f(*values)

    def moving(*some: Tensor) -> Tensor:
        full = list(values)
        for k, x in zip(paired, some, strict=True):
            full[k] = x
        return f(*full)

    found = partial_derivatives(moving, *(values[k] for k in paired))
    tangents = [slope * xs[k].tangent for k, slope in zip(paired, found, strict=True)]
    return Pair.of(f(*values), torch.stack(tangents).sum(0) if len(tangents) > 1 else tangents[0])


class _InReverse(torch.autograd.Function):
    """An elementwise function in reverse mode, by its slopes in forward mode.

    A branch that is not taken (torch.where) may have no slope: forward mode passes it by, reverse mode would multiply it
    by zero, to nan.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(f: Callable[..., Tensor], *xs: Tensor) -> Tensor:
        return f(*xs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.f = inputs[0]
        ctx.save_for_backward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> tuple:
        xs = ctx.saved_tensors
        found = zip(xs, partial_derivatives(ctx.f, *xs), ctx.needs_input_grad[1:], strict=True)
        return None, *((bars[0] * slope).sum_to_size(x.shape) if needed else None for x, slope, needed in found)


def reciprocal(x: Any) -> Any:
    return function(lambda y: 1.0 / y, lambda y: -1.0 / (y * y), x)
