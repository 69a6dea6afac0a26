"""All elements of a flexible beam, as one force element between the bodies at its nodes.

Checked in tests/multibody/bodies/test_flexible_beam.py.
"""

from __future__ import annotations

from typing import Any, ClassVar

from torch import Tensor

from torchmbd.math.variable import ParameterVector
from torchmbd.multibody.bodies.flexible_beam import FlexibleBeam
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.joints.joint import AttachmentTable


class BeamChain(ForceElement):
    """All elements of one FlexibleBeam; made by the System."""

    variables_in_laws: ClassVar[bool] = False

    def __init__(self, beam: FlexibleBeam):
        super().__init__(tuple(node.at() for node in beam.node_bodies), beam.name)
        self.beam = beam

    @property
    def variables(self) -> ParameterVector | None:
        """The parameters of the beam."""
        return ParameterVector.of(self.beam)

    def actions(self, attachments: AttachmentTable) -> list[Any]:
        """No actions: the forces are those of beam elements."""
        return []

    def beams(self, attachments: AttachmentTable) -> list[tuple[int, int]]:
        """Attached points at both ends of each element."""
        points = [attachments.point(frame) for frame in self.frames]
        return [(points[i], points[j]) for i, j in self.beam.mesh.elements.tolist()]

    def beam_data(self) -> dict[str, Tensor]:
        """The data of `FlexibleBeam.structure`."""
        return self.beam.structure().data
