"""Value-tangent pairs: one text of the physics serves values and all design tangents.

    x(b)  ->  [x, dx/db_1, ..., dx/db_n]          f: [x, dx] -> [f(x), f'(x) dx]

A number of the motion stage is a plain tensor or a `Pair`. Both end with a slot axis and a lane axis:

    tensor      [component..., 1, lane]          a value; no tangent, which is skipped, not multiplied by zero
    Pair.full   [component..., 1 + n_b, lane]    slot 0 the value, then one slot for each design variable

Value and tangents share one tensor, so a linear map is one operator, and a product two. An eager operator costs about
5 us whatever its size: this counts more than flops, and it is 3-6 times cheaper than functorch.

The functions below take tensors and pairs alike. Component axes are counted from the front, so one index means the
same for both. Plain tensors are differentiable in reverse mode as any torch code.
Checked in tests/numerics/test_pair.py against torch.func.jvp.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


class Pair:
    """A value with its tangents for every design variable, side by side in `full` [component..., 1 + n_b, lane]."""

    __slots__ = ("full",)

    def __init__(self, full: Tensor):
        self.full = full

    @classmethod
    def of(cls, value: Tensor, tangent: Tensor) -> Pair:
        """Join a value [component..., 1, lane] and its tangents [component..., n_b, lane]."""
        lanes = max(value.shape[-1], tangent.shape[-1])
        return cls(torch.cat([x.expand(*x.shape[:-1], lanes) for x in (value, tangent)], -2))

    @property
    def value(self) -> Tensor:
        return self.full[..., :1, :]

    @property
    def tangent(self) -> Tensor:
        return self.full[..., 1:, :]

    @property
    def shape(self) -> torch.Size:
        return self.full.shape

    def __getitem__(self, index: Any) -> Pair:
        return Pair(self.full[index])

    def __neg__(self) -> Pair:
        return Pair(-self.full)

    def __add__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return Pair(self.full + other.full)
        return Pair(self.full + _zero_tangents(other, self.full))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return Pair(self.full - other.full)
        return Pair(self.full - _zero_tangents(other, self.full))

    def __rsub__(self, other: Any) -> Pair:
        return Pair(_zero_tangents(other, self.full) - self.full)

    def __mul__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return _product(torch.mul, self, other)
        return Pair(self.full * other)

    __rmul__ = __mul__

    def sum(self, dim: int | tuple[int, ...]) -> Pair:
        return Pair(self.full.sum(dim))

    def transpose(self, i: int, j: int) -> Pair:
        return Pair(self.full.transpose(i, j))

    def unsqueeze(self, dim: int) -> Pair:
        return Pair(self.full.unsqueeze(dim))

    def unflatten(self, dim: int, sizes: Sequence[int]) -> Pair:
        return Pair(self.full.unflatten(dim, sizes))

    def flatten(self, start: int, end: int) -> Pair:
        return Pair(self.full.flatten(start, end))

    def index_select(self, dim: int, index: Tensor) -> Pair:
        return Pair(self.full.index_select(dim, index))


def _zero_tangents(x: Tensor | float, like: Tensor) -> Tensor:
    """A constant as a full tensor with tangents of zero."""
    full = like.new_zeros(*([1] * (like.dim() - 2)), like.shape[-2], 1)
    if isinstance(x, Tensor):
        full = like.new_zeros(*x.shape[:-2], like.shape[-2], x.shape[-1])
        full[..., :1, :] = x
    else:
        full[..., 0, :] = x
    return full


def value(x: Any) -> Tensor:
    """The value part [component..., 1, lane]."""
    return x.value if isinstance(x, Pair) else x


def linear(f: Callable[[Tensor], Tensor], x: Any) -> Any:
    """Apply a linear map to the component axes."""
    return Pair(f(x.full)) if isinstance(x, Pair) else f(x)


def _product(f: Callable[[Tensor, Tensor], Tensor], a: Pair, b: Pair) -> Pair:
    """The product rule: [a, da] b, then a db is added to the tangents."""
    full = f(a.full, b.value)
    if f is torch.mul:
        full[..., 1:, :].addcmul_(a.value, b.tangent)
    else:
        full[..., 1:, :] += f(a.value, b.tangent)
    return Pair(full)


def bilinear(f: Callable[[Tensor, Tensor], Tensor], a: Any, b: Any) -> Any:
    """Apply a map that is linear in each of two numbers."""
    if isinstance(a, Pair):
        return _product(f, a, b) if isinstance(b, Pair) else Pair(f(a.full, b))
    return Pair(f(a, b.full)) if isinstance(b, Pair) else f(a, b)


def contract(a: Any, b: Any, dims: int | tuple[int, ...]) -> Any:
    """Multiply two numbers that broadcast, and sum over component axes."""
    return (a * b).sum(dims)


def function(f: Callable[[Tensor], Tensor], df: Callable[[Tensor], Tensor], x: Any) -> Any:
    """Apply a scalar function, elementwise, given with its derivative."""
    if isinstance(x, Pair):
        return Pair(torch.cat([f(x.value), df(x.value) * x.tangent], -2))
    return f(x)


def sin(x: Any) -> Any:
    return function(torch.sin, torch.cos, x)


def cos(x: Any) -> Any:
    return function(torch.cos, lambda y: -torch.sin(y), x)


def combine(x: Any, factor: Any, y: Any) -> Any:
    """x + factor y, for a factor without axes."""
    if isinstance(factor, Tensor):
        return x + factor * y
    if isinstance(x, Pair) and isinstance(y, Pair):
        return Pair(torch.add(x.full, y.full, alpha=factor))
    if isinstance(x, Pair) or isinstance(y, Pair):
        return x + factor * y
    return torch.add(x, y, alpha=factor)


def cat(parts: Sequence[Any], dim: int = 0) -> Any:
    """Concatenate along a component axis; a constant among pairs has tangents of zero."""
    pairs = [x for x in parts if isinstance(x, Pair)]
    if not pairs:
        return torch.cat(_same_lanes(list(parts)), dim)
    like = pairs[0].full
    return Pair(
        torch.cat(_same_lanes([x.full if isinstance(x, Pair) else _zero_tangents(x, like) for x in parts]), dim)
    )


def _same_lanes(parts: list[Tensor]) -> list[Tensor]:
    """Expand parts that hold for all lanes to the lanes of the others."""
    lanes = max(x.shape[-1] for x in parts)
    return [x if x.shape[-1] == lanes else x.expand(*x.shape[:-1], lanes) for x in parts]


def cross(a: Any, b: Any) -> Any:
    """Cross product over the first axis."""
    return bilinear(_cross, a, b)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b, dim=0)


def dot(a: Any, b: Any) -> Any:
    """Scalar product over the first axis."""
    return contract(a, b, 0)


def matvec(A: Any, x: Any) -> Any:
    """Contract the second axis of A with the first of x: y_i... = A_ij... x_j..."""
    return contract(A, x, 1)


def matvec_t(A: Any, x: Any) -> Any:
    """Contract the first axis of A with the first of x: y_j... = A_ij... x_i..."""
    return contract(A, x.unsqueeze(1), 0)


def matmul(A: Any, B: Any) -> Any:
    """Contract the second axis of A with the first of B: C_ik... = A_ij... B_jk..."""
    return contract(A.unsqueeze(2), B, 1)


def constant_map(C: Tensor, x: Any) -> Any:
    """Contract a constant matrix [m, k] with the first axis of x [k, ...]: one BLAS call, any number of lanes."""
    return linear(lambda y: (C @ y.flatten(1)).unflatten(1, y.shape[1:]), x)
