"""Finite elements: laminated triangles and quadrilaterals, stresses of plies, beams of any section; parts make up a body."""

from torchmbd.elements.assembly import Assembly
from torchmbd.elements.beam import BeamMatrices
from torchmbd.elements.beam_line import BeamLine
from torchmbd.elements.beam_section import BeamSection, GivenSection
from torchmbd.elements.beams import Beams
from torchmbd.elements.freedoms import Average, Freedoms, RigidLink
from torchmbd.elements.part import MassPoints, Part
from torchmbd.elements.plate import PlateMatrices
from torchmbd.elements.plates import MASSES, Plates, PointMasses, merged
from torchmbd.elements.ply_recovery import PlyBasis, ply_basis, ply_points
from torchmbd.elements.shell_elements import ELEMENTS
from torchmbd.elements.strains import FREEDOMS

__all__ = [
    "ELEMENTS", "FREEDOMS", "MASSES", "Assembly", "Average", "BeamLine", "BeamMatrices", "BeamSection", "Beams", "Freedoms",
    "GivenSection", "MassPoints", "Part", "PlateMatrices", "Plates", "PlyBasis", "PointMasses", "RigidLink", "merged",
    "ply_basis", "ply_points",
]  # fmt: skip
