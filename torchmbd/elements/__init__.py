"""Finite elements: laminated Mindlin-Reissner triangles with six freedoms a node, and the stresses of their plies."""

from torchmbd.elements.plate import PlateMatrices
from torchmbd.elements.ply_recovery import PlyBasis, ply_basis, ply_points
from torchmbd.elements.strains import FREEDOMS

__all__ = ["FREEDOMS", "PlateMatrices", "PlyBasis", "ply_basis", "ply_points"]
