"""Elementwise functions of tensors and of pairs (pair.py).

    f([x, dx]) = [f(x), f'(x) dx]

Checked in tests/math/test_pair.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.forward_mode import jvp
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


def tanh(x: Any) -> Any:
    return function(torch.tanh, lambda y: 1.0 - torch.tanh(y) * torch.tanh(y), x)


def angle_near(s: Any, c: Any, center: Any) -> Any:
    """The angle of the point (c, s) within half a turn of a center, a float or tensor; it varies with s and c alone."""
    number = isinstance(center, (int, float))
    c0, s0 = (math.cos(center), math.sin(center)) if number else (torch.cos(center), torch.sin(center))

    def angle(s: Tensor, c: Tensor) -> Tensor:
        return torch.atan2(s * c0 - c * s0, c * c0 + s * s0) + center

    if not isinstance(s, Pair):
        return angle(s, c)
    square = s.value * s.value + c.value * c.value
    return Pair.of(angle(s.value, c.value), (c.value * s.tangent - s.value * c.tangent) / square)


def partial_derivatives(f: Callable[..., Tensor], *xs: Tensor) -> list[Tensor]:
    """Partial derivatives of an elementwise function by each of its arguments."""
    result = []
    for k, x in enumerate(xs):
        of_one: Any = jvp(lambda y, k=k: f(*xs[:k], y, *xs[k + 1 :]), (x,), (torch.ones_like(x),))
        result.append(of_one[1])
    return result


def apply_elementwise(f: Callable[..., Tensor], *xs: Any) -> Any:
    """Apply an elementwise function of tensors or pairs; its derivatives come from forward mode, also in reverse mode."""
    paired = [k for k, x in enumerate(xs) if isinstance(x, Pair)]
    values = [value(x) for x in xs]
    if not paired:
        return _InReverse.apply(f, *values) if any(x.requires_grad for x in values) else f(*values)

    def of_pairs(*pair_values: Tensor) -> Tensor:
        arguments = list(values)
        for k, x in zip(paired, pair_values, strict=True):
            arguments[k] = x
        return f(*arguments)

    slopes = partial_derivatives(of_pairs, *(values[k] for k in paired))
    tangents = [slope * xs[k].tangent for k, slope in zip(paired, slopes, strict=True)]
    return Pair.of(f(*values), torch.stack(tangents).sum(0) if len(tangents) > 1 else tangents[0])


class _InReverse(torch.autograd.Function):
    """An elementwise function in reverse mode, by its derivatives in forward mode.

    The unused branch of torch.where may have an infinite derivative: forward mode selects the other branch, reverse mode would
    multiply by zero and give nan.
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
    def backward(ctx: Any, *cotangents: Tensor) -> tuple:
        xs = ctx.saved_tensors
        arguments = zip(xs, partial_derivatives(ctx.f, *xs), ctx.needs_input_grad[1:], strict=True)
        return None, *(
            (cotangents[0] * slope).sum_to_size(x.shape) if needed else None for x, slope, needed in arguments
        )


def reciprocal(x: Any) -> Any:
    return function(lambda y: 1.0 / y, lambda y: -1.0 / (y * y), x)
