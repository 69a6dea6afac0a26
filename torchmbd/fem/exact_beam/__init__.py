"""Geometrically exact beams: finite displacements and rotations of beams with 6 x 6 sections."""

from torchmbd.fem.exact_beam.beam import BeamState, ExactBeam
from torchmbd.fem.exact_beam.section_table import SectionTable

__all__ = ["BeamState", "ExactBeam", "SectionTable"]
