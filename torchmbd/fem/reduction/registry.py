"""The reductions of flexible bodies by name.

    name               span                                                                          modes
    "vibration"        the m lowest modes of the body fixed at its reference (basis.py)              m
    "craig-bampton"    constraint modes of interface degrees of freedom, m fixed-interface modes               i + m

m is the number n that was requested, or up to MORE more: each design is cut in a wide gap (cut.py). Static shapes, such as
those of a change of temperature, are added to both, as many as are independent in a design (static_shapes.py).

A reduction maps K and M of the free degrees of freedom to a basis that is orthonormal in M and a full reduced stiffness, with
exact derivatives. `updated=False` holds the basis fixed while the stiffness is differentiated (eq. 36): the fixed-mode
approach of section 4.2, for comparison only; its gradients are wrong in general. True: updated modes, eqs. (34)-(35).
Checked in tests/fem/reduction/test_craig_bampton.py, tests/sensitivity/test_eigen_fixed_modes.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import Matrix, ModalBasis, fixed_modes, modal_basis
from torchmbd.fem.reduction.craig_bampton import craig_bampton
from torchmbd.fem.reduction.static_shapes import StaticShapes
from torchmbd.math.sparse import SparseMatrix

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
    shapes: StaticShapes | None = None

    def __post_init__(self) -> None:
        if self.interface:
            raise InputError("interface", allowed="left out with reduction 'vibration'", state="is given")

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        return _with_shapes(self, K, M, lambda K, M, updated: modal_basis(K, M, self.n, updated=updated, more=MORE))

    @property
    def counts(self) -> range:
        """Numbers of modes that designs may have."""
        return range(self.n, self.n + self.kept + MORE + 1)

    @property
    def kept(self) -> int:
        """Largest number of shapes beside the n modes."""
        return 0 if self.shapes is None else self.shapes.count


@dataclass(frozen=True)
class CraigBampton:
    """Interface degrees of freedom and the lowest fixed-interface modes, at least n; see the module header."""

    n: int
    interface: Sequence[int] = ()
    updated: bool = True
    shapes: StaticShapes | None = None

    def __post_init__(self) -> None:
        if not self.interface:
            raise InputError(
                "interface", allowed="must have at least one node with reduction 'craig-bampton'", state="is empty"
            )

    def __call__(self, K: Matrix, M: Matrix) -> ModalBasis:
        def reduce(K: Matrix, M: Matrix, updated: bool) -> ModalBasis:
            return craig_bampton(K, M, self.n, self.interface, updated=updated, more=MORE)

        return _with_shapes(self, K, M, reduce)

    @property
    def counts(self) -> range:
        """Numbers of modes that designs may have."""
        return range(self.n + len(self.interface), self.n + self.kept + MORE + 1)

    @property
    def kept(self) -> int:
        """Largest number of shapes beside the n modes."""
        return len(self.interface) + (0 if self.shapes is None else self.shapes.count)


def _with_shapes(
    reduction: VibrationModes | CraigBampton, K: Matrix, M: Matrix, reduce: Callable[[Matrix, Matrix, bool], ModalBasis]
) -> ModalBasis:
    """The basis of a reduction with its static shapes."""
    shapes = reduction.shapes
    if shapes is None:
        return reduce(K, M, reduction.updated)
    if not isinstance(K, SparseMatrix):
        raise InputError("K", K, "a SparseMatrix, for static shapes")

    def whole(K: Any, M: Matrix) -> ModalBasis:
        return shapes(reduce(K, M, True), K, M)

    return whole(K, M) if reduction.updated else fixed_modes(K, M, whole)


REDUCTIONS: dict[str, type[VibrationModes] | type[CraigBampton]] = {
    "vibration": VibrationModes,
    "craig-bampton": CraigBampton,
}
