"""Finite elements: laminated Mindlin-Reissner triangles, stresses of their plies, and how parts make up a body."""

from torchmbd.elements.assembly import Assembly, MassPoints, Part
from torchmbd.elements.freedoms import Average, Freedoms, RigidLink
from torchmbd.elements.plate import PlateMatrices
from torchmbd.elements.plates import MASSES, Plates, PointMasses
from torchmbd.elements.ply_recovery import PlyBasis, ply_basis, ply_points
from torchmbd.elements.strains import FREEDOMS

__all__ = [
    "FREEDOMS", "MASSES", "Assembly", "Average", "Freedoms", "MassPoints", "Part", "PlateMatrices", "Plates", "PlyBasis",
    "PointMasses", "RigidLink", "ply_basis", "ply_points",
]  # fmt: skip
