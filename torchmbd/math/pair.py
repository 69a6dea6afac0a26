"""Value-tangent pairs: the same code computes values and all design tangents.

    x(b)  ->  [x, dx/db_1, ..., dx/db_n]          f: [x, dx] -> [f(x), f'(x) dx]

A number of the motion stage is a plain tensor or a `Pair`. Both end with the axis of the pair and the axis of lanes:

    tensor      [component..., 1, lane]          a value without tangents; no operation is spent on zeros
    Pair.full   [component..., 1 + n_b, lane]    the value, then a tangent for each design variable

Value and tangents are one tensor, so a linear map is one operator, and a product two. A small eager operator costs about 5 us
whatever its size, so the number of operators decides; this is 3-6 times cheaper than functorch.

Where functions are translated to scalar code (by a backend), value and tangents are two tensors (`separate_tangents`),
because generated code has one function for values and another for tangents.

The functions below accept tensors and pairs. Component axes are counted from the front, so an index has the same meaning for
both. Plain tensors are differentiable in reverse mode as any torch code.
Checked in tests/math/test_pair.py against torch.func.jvp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor

# (a x b)_k as a linear map of the nine products a_i b_j: half the time of torch.linalg.cross.
_UNIT = torch.eye(3, dtype=torch.float64)
CROSS_FORM = torch.linalg.cross(_UNIT[:, :, None], _UNIT[:, None], dim=0).reshape(3, 9)


class Pair:
    """A value with its tangents for every design variable, concatenated in `full` [component..., 1 + n_b, lane]."""

    __slots__ = ("_tangent", "_value", "full")

    def __init__(self, full: Tensor):
        self.full = full
        self._value = self._tangent = None

    @staticmethod
    def of(value: Tensor, tangent: Tensor) -> Pair:
        """Join a value [component..., 1, lane] and its tangents [component..., n_b, lane]."""
        if _separate.get():
            return _SeparatePair(value, tangent)
        lanes = max(value.shape[-1], tangent.shape[-1])
        return Pair(torch.cat([x.expand(*x.shape[:-1], lanes) for x in (value, tangent)], -2))

    # A view costs as much as a small operator, so it is kept.
    @property
    def value(self) -> Tensor:
        if self._value is None:
            self._value = self.full[..., :1, :]
        return self._value

    @property
    def tangent(self) -> Tensor:
        if self._tangent is None:
            self._tangent = self.full[..., 1:, :]
        return self._tangent

    @property
    def shape(self) -> Any:
        return self.full.shape

    def map(self, f: Callable[[Tensor], Tensor]) -> Pair:
        """Apply a linear map of the component axes."""
        return Pair(f(self.full))

    def plus(self, other: Any, sign: float) -> Pair:
        """self + sign other."""
        full = other.full if isinstance(other, Pair) else _zero_tangents(other, self.full)
        return Pair(torch.add(self.full, full, alpha=sign))

    def times(self, other: Pair) -> Pair:
        """The product by the product rule: [a, da] b, then a db is added to the tangents."""
        product = Pair(self.full * other.value)
        product.tangent.addcmul_(self.value, other.tangent)
        return product

    def __getitem__(self, index: Any) -> Pair:
        return self.map(lambda x: x[index])

    def __neg__(self) -> Pair:
        return self.map(torch.neg)

    def __add__(self, other: Any) -> Pair:
        return self.plus(other, 1.0)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Pair:
        return self.plus(other, -1.0)

    def __rsub__(self, other: Any) -> Pair:
        return (-self).plus(other, 1.0)

    def __mul__(self, other: Any) -> Pair:
        return self.times(other) if isinstance(other, Pair) else self.map(lambda x: x * other)

    __rmul__ = __mul__

    def sum(self, dim: int | tuple[int, ...]) -> Pair:
        return self.map(lambda x: x.sum(dim))

    def transpose(self, i: int, j: int) -> Pair:
        return self.map(lambda x: x.transpose(i, j))

    def unsqueeze(self, dim: int) -> Pair:
        return self.map(lambda x: x.unsqueeze(dim))

    def unflatten(self, dim: int, sizes: Sequence[int]) -> Pair:
        return self.map(lambda x: x.unflatten(dim, sizes))

    def flatten(self, start: int, end: int) -> Pair:
        return self.map(lambda x: x.flatten(start, end))

    def index_select(self, dim: int, index: Tensor) -> Pair:
        return self.map(lambda x: x.index_select(dim, index))


class _SeparatePair(Pair):
    """A pair with value and tangents in two tensors, of which one may have a single lane."""

    __slots__ = ()

    def __init__(self, value: Tensor, tangent: Tensor):
        self._value, self._tangent = value, tangent

    @property
    def full(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        return torch.cat(_same_lanes([self._value, self._tangent]), -2)

    @property
    def value(self) -> Tensor:
        return self._value

    @property
    def tangent(self) -> Tensor:
        return self._tangent

    @property
    def shape(self) -> Any:
        pair = 1 + self._tangent.shape[-2]
        lanes = max(self._value.shape[-1], self._tangent.shape[-1])
        return (*self._value.shape[:-2], pair, lanes)

    def map(self, f: Callable[[Tensor], Tensor]) -> Pair:
        return _SeparatePair(f(self._value), f(self._tangent))

    def plus(self, other: Any, sign: float) -> Pair:
        if isinstance(other, Pair):
            return _SeparatePair(self._value + sign * other.value, self._tangent + sign * other.tangent)
        total = self._value + sign * other
        return _SeparatePair(total, self._tangent.expand(*total.shape[:-2], *self._tangent.shape[-2:]))

    def times(self, other: Pair) -> Pair:
        return _SeparatePair(self._value * other.value, self._tangent * other.value + self._value * other.tangent)


_separate: ContextVar[bool] = ContextVar("separate", default=False)  # in this thread


@contextmanager
def separate_tangents() -> Iterator[None]:
    """Context in which new pairs of this thread have values and tangents in two tensors."""
    token = _separate.set(True)
    try:
        yield
    finally:
        _separate.reset(token)


def _zero_tangents(x: Tensor | float, like: Tensor) -> Tensor:
    """A constant as a full tensor with tangents of zero."""
    full = like.new_zeros(*([1] * (like.dim() - 2)), like.shape[-2], 1)
    if isinstance(x, Tensor):
        full = like.new_zeros(*x.shape[:-2], like.shape[-2], x.shape[-1])
        full[..., :1, :] = x
    else:
        full[..., 0, :] = x
    return full


def variation(x: Any) -> Tensor:
    """The variation of x: the tangents of a pair; of a tensor zero with the derivative of x in reverse mode."""
    return x.tangent if isinstance(x, Pair) else x - x.detach()


def value(x: Any) -> Tensor:
    """The value part [component..., 1, lane]."""
    return x.value if isinstance(x, Pair) else x


def linear(f: Callable[[Tensor], Tensor], x: Any) -> Any:
    """Apply a linear map to the component axes."""
    return x.map(f) if isinstance(x, Pair) else f(x)


def contract(a: Any, b: Any, dims: int | tuple[int, ...]) -> Any:
    """Multiply two numbers that broadcast, and sum over component axes."""
    product = a * b
    # One sum over several axes takes three times as long in torch.
    for summed, dim in enumerate((dims,) if isinstance(dims, int) else dims):
        product = product.sum(dim - summed)
    return product


def combine(x: Any, factor: Any, y: Any) -> Any:
    """x + factor y, for a factor without component axes."""
    if isinstance(factor, (Tensor, Pair)):
        return x + factor * y
    if isinstance(x, Pair):
        return x.plus(y, factor) if isinstance(y, Pair) else x + factor * y
    return x + factor * y if isinstance(y, Pair) else torch.add(x, y, alpha=factor)


def cat(parts: Sequence[Any], dim: int = 0) -> Any:
    """Concatenate along a component axis; a constant among pairs has tangents of zero."""
    pairs = [x for x in parts if isinstance(x, Pair)]
    if not pairs:
        return torch.cat(_same_lanes(list(parts)), dim)
    if _separate.get():
        like = pairs[0].tangent
        parts = [x if isinstance(x, Pair) else _SeparatePair(x, _no_tangents(x, like)) for x in parts]
        values, tangents = [x.value for x in parts], [x.tangent for x in parts]
        return _SeparatePair(torch.cat(_same_lanes(values), dim), torch.cat(_same_lanes(tangents), dim))
    like = pairs[0].full
    full = [x.full if isinstance(x, Pair) else _zero_tangents(x, like) for x in parts]
    return Pair(torch.cat(_same_lanes(full), dim))


def _no_tangents(x: Tensor, like: Tensor) -> Tensor:
    return like.new_zeros(1).expand(*x.shape[:-2], *like.shape[-2:])


def _same_lanes(parts: list[Tensor]) -> list[Tensor]:
    """Expand parts of one lane to the lanes of the others."""
    lanes = max(x.shape[-1] for x in parts)
    return [x if x.shape[-1] == lanes else x.expand(*x.shape[:-1], lanes) for x in parts]


def cross(a: Any, b: Any) -> Any:
    """Cross product over the first axis."""
    products = a.unsqueeze(1) * b.unsqueeze(0)
    return constant_map(CROSS_FORM, products.flatten(0, 1))


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


def apply(A: Any, x: Tensor) -> Tensor:
    """A x [n, pair, lanes] of matrices A [lanes, n, m], or of what multiplies by @ as they do, and x [m, pair, lanes]."""
    return (A @ x.permute(2, 0, 1)).permute(1, 2, 0)
