"""Finite elements: laminated Mindlin-Reissner triangles with six freedoms a node."""

from torchmbd.elements.plate import PlateMatrices
from torchmbd.elements.strains import FREEDOMS

__all__ = ["FREEDOMS", "PlateMatrices"]
