"""Plies and laminates: from elastic constants and angles to plate stiffness."""

from torchmbd.materials.isotropic_mean import IsotropicMean
from torchmbd.materials.laminate import ENTRIES, Laminate, LaminateStiffness
from torchmbd.materials.ply import Ply

__all__ = ["ENTRIES", "IsotropicMean", "Laminate", "LaminateStiffness", "Ply"]
