"""Products of the structure stage (math/products.py) as compiled code (compiled_products.cpp): one design after another.

torch computes each operation for a whole batch of designs, which does not fit into the cache of the processor; one design
after another does, and there is no call for each block.
`compiled_products` returns None if there is no compiled code (no compiler, switched off, another device): torch is used then.
Checked in tests/extensions/native/test_compiled_products.py.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_long, c_void_p
from typing import Any

import torch
from torch import Tensor

from torchmbd.extensions.native.codegen.compiler import Native
from torchmbd.math.products import Factor, Products
from torchmbd.math.sparse import Pattern

_native = Native("extensions/native/compiled_products.cpp")


class _Factor(ctypes.Structure):
    """The struct of this name in compiled_products.cpp: fields, order and types are the same."""

    _fields_ = (
        ("lanes", c_long),
        ("blocks", c_long),
        ("bounds", POINTER(c_long)),
        ("at", c_void_p),
    )


def compiled_products(like: Tensor) -> CompiledProducts | None:
    """The compiled products for tensors on the device of `like`; None if there are none."""
    code = _native() if like.device.type == "cpu" else None
    return None if code is None else CompiledProducts(code)


def _struct(factor: Factor) -> Any:
    """What a library takes of a factorization, made once for it."""
    if factor.struct is None:
        n = len(factor.bounds)
        factor.struct = byref(_Factor(len(factor.flat), n - 1, (c_long * n)(*factor.bounds), factor.flat.data_ptr()))
    return factor.struct


class CompiledProducts(Products):
    """The functions of the compiled library."""

    def __init__(self, code: ctypes.CDLL) -> None:
        self._code = code
        code.conjugate_gradients.restype = c_long

    def factorize(self, factor: Factor) -> Tensor:
        pivot = torch.empty(len(factor.flat), dtype=torch.float64)
        self._code.factorize(_struct(factor), *_pointers(pivot))
        return pivot

    def solve(self, factor: Factor, X: Tensor) -> Tensor:
        X = X.contiguous()
        out = torch.empty_like(X)
        self._code.solve(_struct(factor), *_pointers(X, out), c_long(X.shape[2]))
        return out

    def lanczos(
        self, factor: Factor, G: Tensor, start: int, end: int, Q: Tensor, T: Tensor, X: Tensor, R: Tensor
    ) -> None:
        assert all(x.is_contiguous() for x in (G, Q, T, X, R))
        numbers = map(c_long, (start, end, Q.shape[2], X.shape[2]))
        self._code.lanczos(_struct(factor), *_pointers(G), *numbers, *_pointers(Q, T, X, R))

    def multiply_sparse(self, pattern: Pattern, values: Tensor, X: Tensor) -> Tensor:
        (lanes, T, _), values, X = values.shape, values.contiguous(), X.contiguous()
        out = X.new_empty(lanes, T, *X.shape[1:])
        indices = c_void_p(pattern.indptr.ctypes.data), c_void_p(pattern.indices.ctypes.data)
        numbers = map(c_long, (lanes, T, pattern.size))
        self._code.multiply_sparse(*numbers, *indices, *_pointers(values, X, out), c_long(X.shape[2]))
        return out

    def products_at_pattern(self, pattern: Pattern, Y: Tensor, X: Tensor) -> Tensor:
        (lanes, T, N, p), Y, X = Y.shape, Y.contiguous(), X.contiguous()
        out = X.new_empty(lanes, T, pattern.nnz)
        indices = c_void_p(pattern.indptr.ctypes.data), c_void_p(pattern.indices.ctypes.data)
        self._code.products_at_pattern(*map(c_long, (lanes, T, N)), *indices, *_pointers(Y, X, out), c_long(p))
        return out

    def sums(self, start: Tensor, terms: Tensor, x: Tensor) -> Tensor:
        x = x.contiguous()
        out = x.new_empty(len(x), len(start) - 1)
        self._code.sums(*map(c_long, (len(x), len(start) - 1, x.shape[1])), *_pointers(start, terms, x, out))
        return out

    def transposed_sums(self, start: Tensor, terms: Tensor, y: Tensor, size: int) -> Tensor:
        y = y.contiguous()
        out = y.new_zeros(len(y), size)
        self._code.transposed_sums(*map(c_long, (len(y), len(start) - 1, size)), *_pointers(start, terms, y, out))
        return out

    def quadratic_forms(self, law: Tensor, d: Tensor, e: Tensor) -> Tensor:
        same, law, d = e is d, law.contiguous(), d.contiguous()
        e = d if same else e.contiguous()
        out = d.new_empty(len(law), law.shape[1], d.shape[-1], d.shape[-1])
        numbers = map(c_long, (len(law), *law.shape[1:3], *d.shape[2:]))
        self._code.quadratic_forms(*numbers, *_pointers(law, d, e, out))
        return out

    def quadratic_slopes(self, law: Tensor, d: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
        law, d, G = law.contiguous(), d.contiguous(), G.contiguous()
        by_law, by_d = torch.empty_like(law), torch.empty_like(d)
        numbers = map(c_long, (len(law), *law.shape[1:3], *d.shape[2:]))
        self._code.quadratic_slopes(*numbers, *_pointers(law, d, G, by_law, by_d))
        return by_law, by_d

    def conjugate_gradients(
        self, factor: Factor, G: Tensor, U: Tensor, inverse_mu: Tensor, target: Tensor, y: Tensor, r: Tensor, most: int
    ) -> bool:
        assert y.is_contiguous()
        kept = [x.contiguous() for x in (G, U, inverse_mu, target, r)]
        G_, U_, mu, limit, rest = _pointers(*kept)
        sizes = c_long(U.shape[2]), c_long(y.shape[2]), c_long(most)
        return not self._code.conjugate_gradients(
            _struct(factor), G_, U_, sizes[0], mu, limit, *_pointers(y), rest, *sizes[1:]
        )


def _pointers(*tensors: Tensor) -> list[c_void_p]:
    return [c_void_p(x.data_ptr()) for x in tensors]
