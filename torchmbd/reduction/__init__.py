"""Reduction of a flexible body: modes, their derivatives, inertia invariants. Knows matrices and nodes, no element."""

from .invariants import inertia_invariants

__all__ = ["inertia_invariants"]
