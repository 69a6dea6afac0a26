"""Cross-sections of beams: 2-D finite elements with free warping; stiffness, mass, centers, stresses."""

from torchmbd.fem.sections.generators import box, circle, i_section, rectangle, strip, tube
from torchmbd.fem.sections.mesh import SectionMesh
from torchmbd.fem.sections.orthotropic import Orthotropic
from torchmbd.fem.sections.section import FORCES, Section, SectionStress

__all__ = [
    "FORCES",
    "Orthotropic",
    "Section",
    "SectionMesh",
    "SectionStress",
    "box",
    "circle",
    "i_section",
    "rectangle",
    "strip",
    "tube",
]
