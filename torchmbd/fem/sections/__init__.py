"""Cross-sections of beams: 2-D finite elements with free warping; stiffness, mass, centers, stresses.

>>> section = mbd.sections.tube(0.02, mbd.examples.carbon(), mbd.deg([45, -45]), thickness=0.5e-3, cells=(16, 1))
>>> section.stiffness().shape  # of strains and curvatures to forces and moments
torch.Size([6, 6])
>>> [name for name, _ in section.named_parameters()]
['angles']
"""

from torchmbd.fem.sections.generators import box, circle, i_section, rectangle, strip, tube
from torchmbd.fem.sections.mesh import SectionMesh
from torchmbd.fem.sections.orthotropic import Orthotropic
from torchmbd.fem.sections.profiles import c_section, hat_section, l_section, t_section, z_section
from torchmbd.fem.sections.section import FORCES, Section, SectionStress

__all__ = [
    "FORCES",
    "Orthotropic",
    "Section",
    "SectionMesh",
    "SectionStress",
    "box",
    "c_section",
    "circle",
    "hat_section",
    "i_section",
    "l_section",
    "rectangle",
    "strip",
    "t_section",
    "tube",
    "z_section",
]


def __dir__() -> list[str]:
    return [*__all__]
