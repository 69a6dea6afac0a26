"""Products of the structure stage as compiled code (compiled_products.cpp): a few columns, one design after another.

    factorize, solve         A^-1 X of a block-tridiagonal matrix                      blocks.py
    lanczos                  steps of block Lanczos                                    lanczos.py
    multiply_sparse          K X for many K of one pattern                             forms.py
    products_at_pattern      Y X' at the entries of a pattern                          forms.py
    sums, transposed_sums    sums of selected numbers, and their transpose             math/sums.py
    conjugate_gradients      (1 - H / mu) y = c                                        sparse_modes.py
    quadratic_forms          sums of d' L d over points, and their derivatives         quadratic_forms.py

torch computes each operation for a whole batch of designs, which does not fit into the cache of the processor; one design
after another does, and there is no call for each block. Results agree with torch to rounding.
`compiled_products` returns None if there is no compiled code (no compiler, switched off, another device): torch is used then.
Tensors are float64 on the CPU. No autograd inside. Checked in tests/math/test_compiled_products.py.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, byref, c_long, c_void_p

import torch
from torch import Tensor

from torchmbd.math.codegen.compiler import Native
from torchmbd.math.sparse import Pattern

_native = Native("math/compiled_products.cpp")


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


class Factor:
    """A factorization for compiled code, which reads it by pointers; keeps the memory of these.

    bounds: first rows of the blocks, with the end; flat: storage of S_i^-1 and E_i [lane, :], as in blocks.py
    """

    def __init__(self, bounds: Sequence[int], flat: Tensor) -> None:
        self._kept = flat.contiguous()
        self.lanes, blocks = len(flat), len(bounds) - 1
        self.struct = _Factor(self.lanes, blocks, (c_long * (blocks + 1))(*bounds), flat.data_ptr())


class CompiledProducts:
    """The functions of the compiled library; see the module header."""

    def __init__(self, code: ctypes.CDLL) -> None:
        self._code = code
        code.conjugate_gradients.restype = c_long

    def factorize(self, factor: Factor) -> Tensor:
        """Overwrite D_i and B_i by S_i^-1 and E_i; return the smallest pivot [lane], -1 where the matrix is not definite."""
        pivot = torch.empty(factor.lanes, dtype=torch.float64)
        self._code.factorize(byref(factor.struct), *_pointers(pivot))
        return pivot

    def solve(self, factor: Factor, X: Tensor) -> Tensor:
        """A^-1 X for columns [lane, N, p]."""
        X = X.contiguous()
        out = torch.empty_like(X)
        self._code.solve(byref(factor.struct), *_pointers(X, out), c_long(X.shape[2]))
        return out

    def lanczos(
        self, factor: Factor, G: Tensor, start: int, end: int, Q: Tensor, T: Tensor, X: Tensor, R: Tensor
    ) -> None:
        """Steps of block Lanczos with H = G A^-1 G, in place.

        G [lane, N, 1], Q [lane, N, room], T [lane, room, room], X [lane, N, p], R [lane, p, p]
        """
        assert all(x.is_contiguous() for x in (G, Q, T, X, R))
        numbers = map(c_long, (start, end, Q.shape[2], X.shape[2]))
        self._code.lanczos(byref(factor.struct), *_pointers(G), *numbers, *_pointers(Q, T, X, R))

    def multiply_sparse(self, pattern: Pattern, values: Tensor, X: Tensor) -> Tensor:
        """K X for values [lane, T, nnz] and X [lane, N, p]: [lane, T, N, p]."""
        (lanes, T, _), values, X = values.shape, values.contiguous(), X.contiguous()
        out = X.new_empty(lanes, T, *X.shape[1:])
        indices = c_void_p(pattern.indptr.ctypes.data), c_void_p(pattern.indices.ctypes.data)
        numbers = map(c_long, (lanes, T, pattern.size))
        self._code.multiply_sparse(*numbers, *indices, *_pointers(values, X, out), c_long(X.shape[2]))
        return out

    def products_at_pattern(self, pattern: Pattern, Y: Tensor, X: Tensor) -> Tensor:
        """Y X' at the entries of the pattern, for Y [lane, T, N, p] and X [lane, N, p]: [lane, T, nnz]."""
        (lanes, T, N, p), Y, X = Y.shape, Y.contiguous(), X.contiguous()
        out = X.new_empty(lanes, T, pattern.nnz)
        indices = c_void_p(pattern.indptr.ctypes.data), c_void_p(pattern.indices.ctypes.data)
        self._code.products_at_pattern(*map(c_long, (lanes, T, N)), *indices, *_pointers(Y, X, out), c_long(p))
        return out

    def sums(self, start: Tensor, terms: Tensor, x: Tensor) -> Tensor:
        """Sums of x [lane, size] over terms[start[k] : start[k + 1]]: [lane, rows]."""
        x = x.contiguous()
        out = x.new_empty(len(x), len(start) - 1)
        self._code.sums(*map(c_long, (len(x), len(start) - 1, x.shape[1])), *_pointers(start, terms, x, out))
        return out

    def transposed_sums(self, start: Tensor, terms: Tensor, y: Tensor, size: int) -> Tensor:
        """The transpose of `sums`: [lane, size] of y [lane, rows]."""
        y = y.contiguous()
        out = y.new_zeros(len(y), size)
        self._code.transposed_sums(*map(c_long, (len(y), len(start) - 1, size)), *_pointers(start, terms, y, out))
        return out

    def quadratic_forms(self, law: Tensor, d: Tensor, e: Tensor) -> Tensor:
        """[lane, k, a, a] for law [lane, k, points, ij] and d, e [lane, points, r, s, a]: sums over points and i <= j of law
        times d_i d_j', or d_i e_j' + e_i d_j' where e is another."""
        same, law, d = e is d, law.contiguous(), d.contiguous()
        e = d if same else e.contiguous()
        out = d.new_empty(len(law), law.shape[1], d.shape[-1], d.shape[-1])
        numbers = map(c_long, (len(law), *law.shape[1:3], *d.shape[2:]))
        self._code.quadratic_forms(*numbers, *_pointers(law, d, e, out))
        return out

    def quadratic_slopes(self, law: Tensor, d: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
        """The derivatives of sum G . quadratic_forms(law, d, d) by law and d, for symmetric G [lane, k, a, a]."""
        law, d, G = law.contiguous(), d.contiguous(), G.contiguous()
        by_law, by_d = torch.empty_like(law), torch.empty_like(d)
        numbers = map(c_long, (len(law), *law.shape[1:3], *d.shape[2:]))
        self._code.quadratic_slopes(*numbers, *_pointers(law, d, G, by_law, by_d))
        return by_law, by_d

    def conjugate_gradients(
        self, factor: Factor, G: Tensor, U: Tensor, inverse_mu: Tensor, target: Tensor, y: Tensor, r: Tensor, most: int
    ) -> bool:
        """Improve y [lane, N, p] of residual r in place until |r| <= target [lane, 1, p]; False after `most` steps.

        H = G A^-1 G for G [lane, N, 1]; all vectors are orthogonal to U [lane, N, n].
        """
        assert y.is_contiguous()
        kept = [x.contiguous() for x in (G, U, inverse_mu, target, r)]
        G_, U_, mu, limit, rest = _pointers(*kept)
        sizes = c_long(U.shape[2]), c_long(y.shape[2]), c_long(most)
        return not self._code.conjugate_gradients(
            byref(factor.struct), G_, U_, sizes[0], mu, limit, *_pointers(y), rest, *sizes[1:]
        )


def _pointers(*tensors: Tensor) -> list[c_void_p]:
    return [c_void_p(x.data_ptr()) for x in tensors]
