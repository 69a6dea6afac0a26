"""Static displacements under given loads as further shapes of a modal basis, so that statics under these loads are exact.

    U = K^-1 F,     T = [Psi U] C,     T' M T = 1 but for columns of zeros

    (T' K T) A = (T' M T) A Kr,     A' (T' M T) A = 1,                      basis T A

Psi      the modes of a reduction [..., N, m], orthonormal in M
F        loads on the free degrees of freedom [..., N, k], of the present design
C        orthonormalization by Gram and Schmidt; held constant in derivatives, for only the span of T counts

A shape that modes and earlier shapes have is left out, in each design by itself: moisture expands a metal, or the plies
[45, -45], in the ratio of temperature. A metal has its exact gradients so. [45, -45] does not: a neighbor has two shapes, so at
this design the gradient of a deflection by moisture lacks the part that the second shape would have.

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
from torchmbd.math.gradients import untransformed
from torchmbd.math.sparse import Pattern, SparseMatrix

INDEPENDENT = 1e-5  # least part of a static shape, by modal mass, that modes and earlier shapes do not have


class StaticShapes:
    """Adds the static shapes of `loads`, computed in each design, to a basis.

    loads   () -> F [..., N, k]
    count   k, the most shapes of a design
    """

    def __init__(self, pattern: Pattern, loads: Callable[[], Tensor], count: int) -> None:
        self.loads, self.count, self._static = loads, count, StaticLoads(pattern)

    def __call__(self, basis: ModalBasis, K: SparseMatrix, M: Matrix) -> ModalBasis:
        """The basis with the shapes; lanes that have fewer independent ones than others are padded."""
        U = self._static(K, self.loads())
        B: Float[Tensor, "*lanes N m"] = torch.cat([basis.vectors.expand(*U.shape[:-1], -1), U], -1)
        T = B @ _independent(B, M, self.count)
        stiffness, mass = (T.mT @ (K @ T)), T.mT @ times(M, T)
        whole = small_basis(T, 0.5 * (stiffness + stiffness.mT), 0.5 * (mass + mass.mT))
        most = int(untransformed((T.detach() != 0.0).any(-2).sum(-1)).max())
        return ModalBasis(whole.vectors[..., :most], whole.stiffness[..., :most, :most])


def _independent(B: Tensor, M: Matrix, count: int) -> Float[Tensor, "*lanes m m"]:
    """C, constant: the last `count` columns of B C are those of B, orthonormal to all before; zero where nothing is left."""
    with torch.no_grad():
        B = B.detach()
        unit = torch.eye(B.shape[-1], dtype=B.dtype)
        C = unit[:, :-count].expand(*B.shape[:-2], -1, -1)
        for column in unit[:, -count:].T:
            c = column[:, None].expand(*B.shape[:-2], -1, -1)
            size = _size(B @ c, M)
            for _ in range(2):  # the second time removes what rounding left
                c = c - C @ ((B @ C).mT @ times(M, B @ c))
            rest = _size(B @ c, M)
            kept = rest > INDEPENDENT * size
            C = torch.cat([C, torch.where(kept, c / torch.where(kept, rest, 1.0), 0.0)], -1)
        return C.detach()


def _size(u: Float[Tensor, "*lanes N 1"], M: Matrix) -> Float[Tensor, "*lanes 1 1"]:
    """Square root of the modal mass."""
    return (u * times(M, u)).sum(-2, keepdim=True).sqrt()
