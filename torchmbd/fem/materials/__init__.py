"""Plies and laminates: from elastic constants and angles to plate stiffness, ply stresses and failure."""

from torchmbd.fem.materials.failure_modes import MODES
from torchmbd.fem.materials.isotropic_mean import IsotropicMean, present_mean
from torchmbd.fem.materials.laminate import ENTRIES, Laminate, LaminateStiffness
from torchmbd.fem.materials.ply import Ply
from torchmbd.fem.materials.ply_maps import PlyMaps, ply_maps
from torchmbd.fem.materials.progressive_failure import progressive_failure
from torchmbd.fem.materials.strength import CRITERIA, PLY_COMPONENTS, FailureForms, Strength, tsai_wu, tsai_wu_irf

__all__ = [
    "CRITERIA",
    "ENTRIES",
    "MODES",
    "PLY_COMPONENTS",
    "FailureForms",
    "IsotropicMean",
    "Laminate",
    "LaminateStiffness",
    "Ply",
    "PlyMaps",
    "Strength",
    "ply_maps",
    "present_mean",
    "progressive_failure",
    "tsai_wu",
    "tsai_wu_irf",
]  # fmt: skip
