"""Products of the structure stage (math/products.py) as compiled code (compiled_products.cpp): one design after another.

torch computes each operation for a whole batch of designs, which does not fit into the cache of the processor; one design
after another does, and there is no call for each block. Threads share the designs of a batch (math/threads.py).
`compiled_products` returns None if there is no compiled code (no compiler, switched off, another device): torch is used then.
Checked in tests/extensions/native/test_compiled_products.py.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_long, c_void_p
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchmbd.extensions.native.codegen.compiler import Native
from torchmbd.math.products import Factor, Products, Supernodes
from torchmbd.math.sparse import Pattern
from torchmbd.math.threads import run_blocks

SMALL = 1_000_000  # products that take less time than to wake another thread, about 0.1 ms
STRIP = 16  # columns that a sparse factor solves for together, as in compiled_products.cpp
_native = Native("extensions/native/compiled_products.cpp")


class _Factor(ctypes.Structure):
    """The struct of this name in compiled_products.cpp: fields, order and types are the same."""

    _fields_ = (
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
        factor.struct = byref(_Factor(n - 1, (c_long * n)(*factor.bounds), factor.flat.data_ptr()))
    return factor.struct


class CompiledProducts(Products):
    """The functions of the compiled library."""

    def __init__(self, code: ctypes.CDLL) -> None:
        self._code = code

    def _run(self, name: str, lanes: int, work: int, *arguments: Any) -> int:
        """Call a function for all lanes, on threads where it multiplies more than `work` numbers in each; its status."""
        function = getattr(self._code, name)
        function.restype = c_long if name == "conjugate_gradients" else None  # the others have no status

        def run(begin: int, end: int, _: int) -> int | None:
            return function(c_long(begin), c_long(end), *arguments)

        return run_blocks(run, lanes, None if lanes * work > SMALL else 1)

    def factorize(self, factor: Factor) -> Tensor:
        pivot = torch.empty(len(factor.flat), dtype=torch.float64)
        self._run("factorize", len(pivot), _size(factor) * _width(factor), _struct(factor), *_pointers(pivot))
        return pivot

    def solve(self, factor: Factor, X: Tensor) -> Tensor:
        X = X.contiguous()
        out = torch.empty_like(X)
        columns = X.shape[2]
        self._run("solve", len(X), _size(factor) * columns, _struct(factor), *_pointers(X, out), c_long(columns))
        return out

    def supernodes(self, pattern: Pattern, order: Tensor) -> Supernodes:
        N, order = pattern.size, order.clone()
        first, below_start = torch.empty(2, N + 1, dtype=torch.long)
        function = self._code.supernode_bounds
        function.restype = c_long
        count = function(c_long(N), *_indices(pattern), *_pointers(order, first, below_start))
        first, below_start = first[: count + 1].clone(), below_start[: count + 1].clone()
        below = torch.empty(int(below_start[-1]), dtype=torch.long)
        structure = _pointers(first, below_start, below)
        self._code.supernode_rows(c_long(N), *_indices(pattern), *_pointers(order), c_long(count), *structure)
        width = first.diff()
        heights = torch.repeat_interleave(first[1:] + below_start.diff(), width) - torch.arange(N)
        start = torch.nn.functional.pad(heights.cumsum(0), (1, 0))
        return Supernodes(first, below_start, below, start, order)

    def factorize_supernodes(self, nodes: Supernodes, pattern: Pattern, A: Tensor) -> tuple[Tensor, float]:
        L, pivot, A = A.new_empty(int(nodes.start[-1])), A.new_empty(1), A.contiguous()
        numbers = map(c_long, (pattern.size, len(nodes.first) - 1))
        arrays = _pointers(*nodes, A, L, pivot)
        self._run("factorize_supernodes", 1, len(L), *numbers, *_indices(pattern), *arrays)
        return L, pivot.item()

    def solve_supernodes(self, nodes: Supernodes, L: Tensor, X: Tensor) -> Tensor:
        X = X.contiguous()
        out, columns = torch.empty_like(X), X.shape[1]
        numbers = map(c_long, (len(nodes.order), len(nodes.first) - 1))
        strips, work = -(-columns // STRIP), STRIP * len(L)
        self._run("solve_supernodes", strips, work, *numbers, *_pointers(*nodes, L, X, out), c_long(columns))
        return out

    def lanczos(
        self, factor: Factor, G: Tensor, start: int, end: int, Q: Tensor, T: Tensor, X: Tensor, R: Tensor
    ) -> None:
        assert all(x.is_contiguous() for x in (G, Q, T, X, R))
        room, p = Q.shape[2], X.shape[2]
        work = (end - start) * p * (_size(factor) + 4 * Q.shape[1] * end * p)
        numbers = map(c_long, (start, end, room, p))
        self._run("lanczos", len(Q), work, _struct(factor), *_pointers(G), *numbers, *_pointers(Q, T, X, R))

    def multiply_sparse(self, pattern: Pattern, values: Tensor, X: Tensor) -> Tensor:
        (lanes, T, _), values, X = values.shape, values.contiguous(), X.contiguous()
        out = X.new_empty(lanes, T, *X.shape[1:])
        numbers, indices, columns = map(c_long, (T, pattern.size)), _indices(pattern), X.shape[2]
        work = T * pattern.nnz * columns
        self._run("multiply_sparse", lanes, work, *numbers, *indices, *_pointers(values, X, out), c_long(columns))
        return out

    def products_at_pattern(self, pattern: Pattern, Y: Tensor, X: Tensor) -> Tensor:
        (lanes, T, N, p), Y, X = Y.shape, Y.contiguous(), X.contiguous()
        out = X.new_empty(lanes, T, pattern.nnz)
        numbers, indices = map(c_long, (T, N)), _indices(pattern)
        work = T * pattern.nnz * p
        self._run("products_at_pattern", lanes, work, *numbers, *indices, *_pointers(Y, X, out), c_long(p))
        return out

    def sums(self, start: Tensor, terms: Tensor, x: Tensor) -> Tensor:
        x = x.contiguous()
        out = x.new_empty(len(x), len(start) - 1)
        numbers = map(c_long, (out.shape[1], x.shape[1]))
        self._run("sums", len(x), len(terms), *numbers, *_pointers(start, terms, x, out))
        return out

    def transposed_sums(self, start: Tensor, terms: Tensor, y: Tensor, size: int) -> Tensor:
        y = y.contiguous()
        out = y.new_zeros(len(y), size)
        numbers = map(c_long, (len(start) - 1, size))
        self._run("transposed_sums", len(y), len(terms), *numbers, *_pointers(start, terms, y, out))
        return out

    def quadratic_forms(self, law: Tensor, d: Tensor, e: Tensor) -> Tensor:
        same, law, d = e is d, law.contiguous(), d.contiguous()
        e = d if same else e.contiguous()
        out = d.new_empty(len(law), law.shape[1], d.shape[-1], d.shape[-1])
        numbers = map(c_long, (*law.shape[1:3], *d.shape[2:]))
        self._run("quadratic_forms", len(law), _products(law, d), *numbers, *_pointers(law, d, e, out))
        return out

    def quadratic_slopes(self, law: Tensor, d: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
        law, d, G = law.contiguous(), d.contiguous(), G.contiguous()
        by_law, by_d = torch.empty_like(law), torch.empty_like(d)
        numbers = map(c_long, (*law.shape[1:3], *d.shape[2:]))
        self._run("quadratic_slopes", len(law), _products(law, d), *numbers, *_pointers(law, d, G, by_law, by_d))
        return by_law, by_d

    def conjugate_gradients(
        self, factor: Factor, G: Tensor, U: Tensor, inverse_mu: Tensor, target: Tensor, y: Tensor, r: Tensor, most: int
    ) -> bool:
        assert y.is_contiguous()
        kept = [x.contiguous() for x in (G, U, inverse_mu, target, r)]
        G_, U_, mu, limit, rest = _pointers(*kept)
        columns = y.shape[2]
        arguments = _struct(factor), G_, U_, c_long(U.shape[2]), mu, limit, *_pointers(y), rest, c_long(columns)
        return not self._run("conjugate_gradients", len(y), _size(factor) * columns, *arguments, c_long(most))


def _pointers(*tensors: Tensor) -> list[c_void_p]:
    return [c_void_p(x.data_ptr()) for x in tensors]


def _indices(pattern: Pattern) -> tuple[c_void_p, c_void_p]:
    return c_void_p(pattern.indptr.ctypes.data), c_void_p(pattern.indices.ctypes.data)


def _size(factor: Factor) -> int:
    """The numbers of a factor, each of which a solution multiplies about once for each column."""
    return factor.flat.shape[1]


def _width(factor: Factor) -> int:
    """The rows of the largest block."""
    return max(end - start for start, end in pairwise(factor.bounds))


def _products(law: Tensor, d: Tensor) -> int:
    """The products of quadratic forms: of law [lane, k, points, ij] and d [lane, points, r, s, a]."""
    return law[0].numel() * d.shape[-1] ** 2
