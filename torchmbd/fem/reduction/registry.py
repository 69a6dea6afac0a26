"""The reductions of flexible bodies by name.

    name               span                                                                          modes
    "vibration"        the n lowest modes of the body fixed at its reference (basis.py)              n
    "craig-bampton"    constraint modes of interface freedoms, n fixed-interface modes               i + n

A reduction maps K and M of the free freedoms to a basis that is orthonormal in M and a full reduced stiffness, with exact
derivatives. `updated=False` holds the basis fixed while the stiffness is differentiated (eq. 36): the fixed-mode approach
of section 4.2, for comparison only; its gradients are wrong in general. True: updated modes, eqs. (34)-(35).
Checked in tests/fem/reduction/test_craig_bampton.py, tests/sensitivity/test_eigen_fixed_modes.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import CutCluster, Matrix, ModalBasis, modal_basis
from torchmbd.fem.reduction.craig_bampton import craig_bampton


class Reduction(Protocol):
    """A reduction of a flexible body."""

    @property
    def size(self) -> int:
        """Number of modal coordinates."""
        ...

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        """Basis [..., N, size] and reduced stiffness [..., size, size]."""
        ...


@dataclass(frozen=True)
class VibrationModes:
    """The n lowest modes; see the module header."""

    n: int
    interface: Sequence[int] = ()
    updated: bool = True

    def __post_init__(self) -> None:
        if self.interface:
            raise InputError("interface is given; allowed: none with reduction 'vibration'")

    @property
    def size(self) -> int:
        return self.n

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        return modal_basis(K, M, self.n, updated=self.updated)


@dataclass(frozen=True)
class CraigBampton:
    """Interface freedoms and the n lowest fixed-interface modes; see the module header."""

    n: int
    interface: Sequence[int] = ()
    updated: bool = True

    def __post_init__(self) -> None:
        if not self.interface:
            raise InputError("interface is empty; allowed: at least one node with reduction 'craig-bampton'")

    @property
    def size(self) -> int:
        return len(self.interface) + self.n

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        return craig_bampton(K, M, self.n, self.interface, updated=self.updated)


def with_whole_clusters(
    reduction: VibrationModes | CraigBampton, K: Matrix, M: Matrix
) -> VibrationModes | CraigBampton:
    """Return the reduction with the least number of additional modes that cuts no cluster of equal frequencies of K and M."""
    with torch.no_grad():
        while True:
            try:
                reduction(K, M)
            except CutCluster as error:
                reduction = replace(reduction, n=error.beyond)
            else:
                return reduction


REDUCTIONS: dict[str, type[VibrationModes] | type[CraigBampton]] = {
    "vibration": VibrationModes,
    "craig-bampton": CraigBampton,
}
