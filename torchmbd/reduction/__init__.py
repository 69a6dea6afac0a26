"""Reduction of a flexible body: modes, their derivatives, inertia invariants. Knows matrices and nodes, no element."""

from torchmbd.reduction.basis import CutCluster, Matrix, ModalBasis, modal_basis
from torchmbd.reduction.branches import Branches, eigenpair_branches
from torchmbd.reduction.constraint_modes import constraint_modes
from torchmbd.reduction.craig_bampton import craig_bampton
from torchmbd.reduction.eigenpairs import Eigenpairs, eigenpairs
from torchmbd.reduction.family import REDUCTIONS, CraigBampton, Reduction, VibrationModes, uncut
from torchmbd.reduction.invariants import inertia_invariants
from torchmbd.reduction.spectral import eigenvalues, spectral_function

__all__ = [
    "REDUCTIONS",
    "Branches",
    "CraigBampton",
    "CutCluster",
    "Eigenpairs",
    "Matrix",
    "ModalBasis",
    "Reduction",
    "VibrationModes",
    "constraint_modes",
    "craig_bampton",
    "eigenpair_branches",
    "eigenpairs",
    "eigenvalues",
    "inertia_invariants",
    "modal_basis",
    "spectral_function",
    "uncut",
]
