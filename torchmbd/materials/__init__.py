"""Plies and laminates: from elastic constants and angles to plate stiffness."""

from torchmbd.materials.laminate import ENTRIES, Laminate, LaminateStiffness
from torchmbd.materials.ply import Ply

__all__ = ["ENTRIES", "Laminate", "LaminateStiffness", "Ply"]
