"""Reduction of a flexible body: modes, their derivatives, inertia invariants. Knows matrices and nodes, no element."""

from .basis import ModalBasis, modal_basis
from .invariants import inertia_invariants

__all__ = ["ModalBasis", "inertia_invariants", "modal_basis"]
