"""Finite elements: laminated triangles and quadrilaterals, stresses of plies, beams of any section; parts make up a body."""

from torchmbd.fem.elements.assembly import Assembly
from torchmbd.fem.elements.beam import BeamMatrices
from torchmbd.fem.elements.beam_line import BeamLine
from torchmbd.fem.elements.beam_section import BeamSection, GivenSection
from torchmbd.fem.elements.beams import Beams
from torchmbd.fem.elements.cell_stiffness import ELEMENTS
from torchmbd.fem.elements.freedoms import Freedoms, MeanMotion
from torchmbd.fem.elements.links import Average, Combination, Follower, RigidLink
from torchmbd.fem.elements.part import CHANGES, ExpandingPart, GivenElements, MassPoints, Part, PointMasses
from torchmbd.fem.elements.plate import PlateMatrices, PlyBasis, held_ply_stress, ply_basis, ply_points
from torchmbd.fem.elements.plates import MASSES, Plates, merge_plates
from torchmbd.fem.elements.strains import FREEDOMS

__all__ = [
    "CHANGES",
    "ELEMENTS",
    "FREEDOMS",
    "MASSES",
    "Assembly",
    "Average",
    "BeamLine",
    "BeamMatrices",
    "BeamSection",
    "Beams",
    "Combination",
    "ExpandingPart",
    "Follower",
    "Freedoms",
    "GivenElements",
    "GivenSection",
    "MassPoints",
    "MeanMotion",
    "Part",
    "PlateMatrices",
    "Plates",
    "PlyBasis",
    "PointMasses",
    "RigidLink",
    "held_ply_stress",
    "merge_plates",
    "ply_basis",
    "ply_points",
]  # fmt: skip
