"""Reduction of a flexible body: modes, their derivatives, inertia invariants. Knows matrices and nodes, no element.

>>> K, M = torch.diag(torch.tensor([1.0, 4.0, 9.0], dtype=torch.float64)), torch.eye(3, dtype=torch.float64)
>>> mbd.reduction.eigenpairs(K, M, 2).values.tolist()
[1.0, 4.0]
"""

from torchmbd.fem.reduction.basis import Matrix, ModalBasis, modal_basis
from torchmbd.fem.reduction.branches import Branches, eigenpair_branches
from torchmbd.fem.reduction.constraint_modes import constraint_modes
from torchmbd.fem.reduction.craig_bampton import craig_bampton
from torchmbd.fem.reduction.cut import CutCluster
from torchmbd.fem.reduction.eigenpairs import Eigenpairs, eigenpairs
from torchmbd.fem.reduction.invariants import inertia_invariants
from torchmbd.fem.reduction.registry import REDUCTIONS, CraigBampton, Reduction, VibrationModes
from torchmbd.fem.reduction.spectral import eigenvalues, spectral_function
from torchmbd.fem.reduction.static import StaticLoads
from torchmbd.fem.reduction.static_shapes import StaticShapes

__all__ = [
    "REDUCTIONS",
    "Branches",
    "CraigBampton",
    "CutCluster",
    "Eigenpairs",
    "Matrix",
    "ModalBasis",
    "Reduction",
    "StaticLoads",
    "StaticShapes",
    "VibrationModes",
    "constraint_modes",
    "craig_bampton",
    "eigenpair_branches",
    "eigenpairs",
    "eigenvalues",
    "inertia_invariants",
    "modal_basis",
    "spectral_function",
]


def __dir__() -> list[str]:
    return [*__all__]
