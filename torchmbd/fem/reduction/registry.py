"""The reductions of flexible bodies by name.

    name               span                                                                          modes
    "vibration"        the m lowest modes of the body fixed at its reference (basis.py)              m
    "craig-bampton"    constraint modes of interface freedoms, m fixed-interface modes               i + m

m is the number n that was requested, or up to MORE more: each design is cut in a wide gap (cut.py).

A reduction maps K and M of the free freedoms to a basis that is orthonormal in M and a full reduced stiffness, with exact
derivatives. `updated=False` holds the basis fixed while the stiffness is differentiated (eq. 36): the fixed-mode approach
of section 4.2, for comparison only; its gradients are wrong in general. True: updated modes, eqs. (34)-(35).
Checked in tests/fem/reduction/test_craig_bampton.py, tests/sensitivity/test_eigen_fixed_modes.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import Matrix, ModalBasis, modal_basis
from torchmbd.fem.reduction.craig_bampton import craig_bampton

MORE = 4  # modes that meet: bending in two planes, torsion and extension, and one of the next


class Reduction(Protocol):
    """A reduction of a flexible body."""

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        """Basis [..., N, m] and reduced stiffness [..., m, m]; m of the design that retains most, others are padded."""
        ...


@dataclass(frozen=True)
class VibrationModes:
    """The lowest modes, at least n; see the module header."""

    n: int
    interface: Sequence[int] = ()
    updated: bool = True

    def __post_init__(self) -> None:
        if self.interface:
            raise InputError("interface", allowed="none with reduction 'vibration'", state="is given")

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        return modal_basis(K, M, self.n, updated=self.updated, more=MORE)


@dataclass(frozen=True)
class CraigBampton:
    """Interface freedoms and the lowest fixed-interface modes, at least n; see the module header."""

    n: int
    interface: Sequence[int] = ()
    updated: bool = True

    def __post_init__(self) -> None:
        if not self.interface:
            raise InputError("interface", allowed="at least one node with reduction 'craig-bampton'", state="is empty")

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        return craig_bampton(K, M, self.n, self.interface, updated=self.updated, more=MORE)


REDUCTIONS: dict[str, type[VibrationModes] | type[CraigBampton]] = {
    "vibration": VibrationModes,
    "craig-bampton": CraigBampton,
}
