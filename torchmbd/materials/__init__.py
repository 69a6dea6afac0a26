"""Plies and laminates: from elastic constants and angles to plate stiffness, ply stresses and failure."""

from torchmbd.materials.failure_forms import FailureForms
from torchmbd.materials.isotropic_mean import IsotropicMean
from torchmbd.materials.laminate import ENTRIES, Laminate, LaminateStiffness
from torchmbd.materials.ply import Ply
from torchmbd.materials.ply_maps import PlyMaps, ply_maps
from torchmbd.materials.strength import CRITERIA, PLY_COMPONENTS, Strength, max_stress, tsai_wu, tsai_wu_irf

__all__ = [
    "CRITERIA",
    "ENTRIES",
    "PLY_COMPONENTS",
    "FailureForms",
    "IsotropicMean",
    "Laminate",
    "LaminateStiffness",
    "Ply",
    "PlyMaps",
    "Strength",
    "max_stress",
    "ply_maps",
    "tsai_wu",
    "tsai_wu_irf",
]  # fmt: skip
