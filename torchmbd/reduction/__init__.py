"""Reduction of a flexible body: modes, their derivatives, inertia invariants. Knows matrices and nodes, no element."""

from torchmbd.reduction.basis import ModalBasis, modal_basis
from torchmbd.reduction.branches import Branches, eigenpair_branches
from torchmbd.reduction.continuity import Alignment, align, span
from torchmbd.reduction.eigenpairs import Eigenpairs, eigenpairs
from torchmbd.reduction.invariants import inertia_invariants

__all__ = [
    "Alignment",
    "Branches",
    "Eigenpairs",
    "ModalBasis",
    "align",
    "eigenpair_branches",
    "eigenpairs",
    "inertia_invariants",
    "modal_basis",
    "span",
]
