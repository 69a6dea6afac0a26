"""Reduction of a flexible body: modes, their derivatives, inertia invariants. Knows matrices and nodes, no element."""

from .basis import ModalBasis, modal_basis
from .branches import Branches, eigenpair_branches
from .continuity import Alignment, align, span
from .eigenpairs import Eigenpairs, eigenpairs
from .invariants import inertia_invariants

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
