"""Products of the structure stage that an extension may make faster than operators of torch, one design after another.

    factorize, solve         A^-1 X of a block-tridiagonal matrix                      fem/reduction/blocks.py
    supernodes               the entries of a sparse factor                            fem/reduction/sparse_factor.py
    factorize_supernodes, solve_supernodes      A = L L', A^-1 X                       fem/reduction/sparse_factor.py
    lanczos                  steps of block Lanczos                                    fem/reduction/lanczos.py
    multiply_sparse          K X for many K of one pattern                             fem/reduction/forms.py
    products_at_pattern      Y X' at the entries of a pattern                          fem/reduction/forms.py
    sums, transposed_sums    sums of selected numbers, and their transpose             linear_map.py
    conjugate_gradients      (1 - H / mu) y = c                                        fem/reduction/sparse_modes.py
    quadratic_forms          sums of d' L d over points, and their derivatives         quadratic_forms.py

`compiled_products` is asked before each; None: torch makes it. The table "products" (torchmbd/registry.py) has functions like
this. Tensors are float64 on the CPU, without autograd. Results agree with those of torch to rounding.
Checked in tests/extensions/native/test_compiled_products.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from torchmbd.math.sparse import Pattern
from torchmbd.registry import Registry


class Factor:
    """A factorization by blocks.

    bounds   first rows of the blocks, with the end
    flat     storage of S_i^-1 and E_i [lane, :], as in fem/reduction/blocks.py
    struct   what products keep with it
    """

    def __init__(self, bounds: Sequence[int], flat: Tensor) -> None:
        self.bounds, self.flat = bounds, flat.contiguous()
        self.struct: Any = None


class Supernodes(NamedTuple):
    """Where a sparse factor P A P' = L L' has entries: its columns, those with the same rows beneath them together.

    first         first columns of supernodes, with the end [supernodes + 1]
    below_start   where the rows below the triangle of each begin [supernodes + 1], in `below` [rows]
    start         where each column of L begins [N + 1] among its values: the diagonal first, then down the column
    order         rows of A in the order of L [N]
    """

    first: Tensor
    below_start: Tensor
    below: Tensor
    start: Tensor
    order: Tensor


class Products(ABC):
    """See the module header."""

    @abstractmethod
    def factorize(self, factor: Factor) -> Tensor:
        """Overwrite D_i and B_i by S_i^-1 and E_i; return the smallest pivot [lane], -1 where the matrix is not definite."""

    @abstractmethod
    def solve(self, factor: Factor, X: Tensor) -> Tensor:
        """A^-1 X for columns [lane, N, p]."""

    @abstractmethod
    def supernodes(self, pattern: Pattern, order: Tensor) -> Supernodes:
        """The supernodes of A on a pattern, after an order of its rows [N]."""

    @abstractmethod
    def factorize_supernodes(self, nodes: Supernodes, pattern: Pattern, A: Tensor) -> tuple[Tensor, float]:
        """The values of L for A [nnz], and the smallest pivot relative to its diagonal entry; -1 if A is not definite."""

    @abstractmethod
    def solve_supernodes(self, nodes: Supernodes, L: Tensor, X: Tensor) -> Tensor:
        """A^-1 X for columns [N, p]."""

    @abstractmethod
    def lanczos(
        self, factor: Factor, G: Tensor, start: int, end: int, Q: Tensor, T: Tensor, X: Tensor, R: Tensor
    ) -> None:
        """Steps of block Lanczos with H = G A^-1 G, in place.

        G [lane, N, 1], Q [lane, N, room], T [lane, room, room], X [lane, N, p], R [lane, p, p]
        """

    @abstractmethod
    def multiply_sparse(self, pattern: Pattern, values: Tensor, X: Tensor) -> Tensor:
        """K X for values [lane, T, nnz] and X [lane, N, p]: [lane, T, N, p]."""

    @abstractmethod
    def products_at_pattern(self, pattern: Pattern, Y: Tensor, X: Tensor) -> Tensor:
        """Y X' at the entries of the pattern, for Y [lane, T, N, p] and X [lane, N, p]: [lane, T, nnz]."""

    @abstractmethod
    def sums(self, start: Tensor, terms: Tensor, x: Tensor) -> Tensor:
        """Sums of x [lane, size] over terms[start[k] : start[k + 1]]: [lane, rows]."""

    @abstractmethod
    def transposed_sums(self, start: Tensor, terms: Tensor, y: Tensor, size: int) -> Tensor:
        """The transpose of `sums`: [lane, size] of y [lane, rows]."""

    @abstractmethod
    def quadratic_forms(self, law: Tensor, d: Tensor, e: Tensor) -> Tensor:
        """[lane, k, a, a] for law [lane, k, points, ij] and d, e [lane, points, r, s, a]: sums over points and i <= j of law
        times d_i d_j', or d_i e_j' + e_i d_j' where e is another."""

    @abstractmethod
    def quadratic_slopes(self, law: Tensor, d: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
        """The derivatives of sum G . quadratic_forms(law, d, d) by law and d, for symmetric G [lane, k, a, a]."""

    @abstractmethod
    def conjugate_gradients(
        self, factor: Factor, G: Tensor, U: Tensor, inverse_mu: Tensor, target: Tensor, y: Tensor, r: Tensor, most: int
    ) -> bool:
        """Improve y [lane, N, p] of residual r in place until |r| <= target [lane, 1, p]; False after `most` steps.

        H = G A^-1 G for G [lane, N, 1]; all vectors are orthogonal to U [lane, N, n].
        """


PRODUCTS: Registry[Callable[[Tensor], Products | None]] = Registry("products", {})


def compiled_products(like: Tensor) -> Products | None:
    """The products for tensors on the device of `like`; None if there are none."""
    for products in PRODUCTS.values():
        if (code := products(like)) is not None:
            return code
    return None
