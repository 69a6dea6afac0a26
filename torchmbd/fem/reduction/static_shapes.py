"""Static displacements under given loads as further shapes of a modal basis, so that statics under these loads are exact.

    U = K^-1 F,     S = U - Psi (Psi' M U), columns of unit modal mass,     T = [Psi S]

    (T' K T) A = (T' M T) A Kr,     A' (T' M T) A = 1,                      basis T A

Psi      the modes of a reduction [..., N, m], orthonormal in M
F        loads on the free freedoms [..., N, k], of the present design

The basis is orthonormal in M, and Kr is diagonal at the design at hand, as for Craig-Bampton (craig_bampton.py). The highest
frequencies are then those of the static shapes.
Differentiable in K, M and F, forward and reverse: each part is in its own right (static.py, basis.py), and A has all modes.
Source: R. H. MacNeal, Comput. Struct. 1 (1971) 581-601 (static shapes beside modes).
Checked in tests/multibody/forces/test_temperature.py.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.reduction.basis import Matrix, ModalBasis
from torchmbd.fem.reduction.craig_bampton import small_basis, times
from torchmbd.fem.reduction.static import StaticLoads
from torchmbd.math.sparse import Pattern, SparseMatrix

INDEPENDENT = 1e-5  # least part of a static shape, by modal mass, that modes and earlier shapes do not have


class StaticShapes:
    """Adds the static shapes of `loads`, computed in each design, to a basis.

    loads     () -> F [..., N, k]
    columns   which of the k loads have shapes that are independent of each other
    """

    def __init__(self, pattern: Pattern, loads: Callable[[], Tensor]) -> None:
        self.loads, self._static = loads, StaticLoads(pattern)
        self.columns: list[int] = []

    @property
    def count(self) -> int:
        """Number of shapes."""
        return len(self.columns)

    def choose(self, basis: ModalBasis, K: SparseMatrix, M: Matrix) -> None:
        """Choose the columns: those that are independent of the modes of the first design and of each other."""
        chosen: list[int] = []
        U = self._static(K, self.loads())
        U = U.reshape(-1, *U.shape[-2:])[:1]
        vectors = basis.vectors.reshape(-1, *basis.vectors.shape[-2:])[:1]
        for k in range(U.shape[-1]):
            u = U[..., k : k + 1]
            size = float((u.mT @ times(M, u)).flatten()[0]) ** 0.5
            for _ in range(2):  # the second time removes what rounding left
                u = u - vectors @ (vectors.mT @ times(M, u))
            rest = float((u.mT @ times(M, u)).flatten()[0]) ** 0.5
            if rest > INDEPENDENT * size:
                chosen.append(k)
                vectors = torch.cat([vectors, u / rest], -1)
        self.columns = chosen

    def __call__(self, basis: ModalBasis, K: SparseMatrix, M: Matrix) -> ModalBasis:
        """The basis with the shapes."""
        if not self.columns:
            return basis
        Psi = basis.vectors
        U = self._static(K, self.loads()[..., self.columns])
        U = U - Psi @ (Psi.mT @ times(M, U))
        U = U / (U * times(M, U)).sum(-2, keepdim=True).sqrt()
        T: Float[Tensor, "*lanes N m"] = torch.cat([Psi.expand(*U.shape[:-1], -1), U], -1)
        stiffness, mass = (T.mT @ (K @ T)), T.mT @ times(M, T)
        return small_basis(T, 0.5 * (stiffness + stiffness.mT), 0.5 * (mass + mass.mT))
