"""Part of an assembly: beams of one section on some elements of a line.

Checked in tests/elements/test_beams.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.elements.assembly import MassPoints
from torchmbd.elements.beam import BeamMatrices, Line
from torchmbd.elements.beam_section import BeamSection, line_transform
from torchmbd.elements.plates import MASSES
from torchmbd.errors import InputError, unknown


class Beams:
    """One section on elements of a line (default: all).

    section       a Section or GivenSection; its parameters are the design
    orientation   the section's y-axis in mesh axes, projected across each element: [3], or one for each [m, 3]
    offset        of the section's origin from the line of the nodes, along the beam's y and z [m]: [2], or [m, 2]
    twist         of the section's y-axis from `orientation`, about the beam's axis [rad]: one, or one for each [m]
    mass          "lumped", half of each element at its ends; "consistent", with linear shape functions, for comparison
    elements      indices of the elements that are made of it; orientation, offset, twist count all elements of the mesh
    """

    def __init__(
        self,
        mesh: Line,
        section: BeamSection,
        orientation: Sequence[float] | Tensor = (0.0, 1.0, 0.0),
        offset: Sequence[float] | Tensor = (0.0, 0.0),
        twist: float | Sequence[float] | Tensor = 0.0,
        elements: Sequence[int] | Tensor | None = None,
        mass: str = "lumped",
    ) -> None:
        if mass not in MASSES:
            raise unknown("mass", mass, MASSES)
        if not (isinstance(section, nn.Module) and isinstance(section, BeamSection)):
            raise InputError(f"section is {section!r}; allowed: a Section or a GivenSection")
        self.section = section
        self.matrices = BeamMatrices(mesh, orientation, elements)
        self.pattern = self.matrices.pattern
        self._to_line = _transforms(offset, twist, len(mesh.elements), self.matrices.members)
        at_line = self._to_line @ section.mass() @ self._to_line.mT
        ends, arm, particles = self.matrices.particles(at_line, mass == "consistent")
        self._points = MassPoints(ends, particles, torch.zeros_like(particles), arm)

    def values(self) -> Float[Tensor, "*lanes nnz"]:
        """K of the present design."""
        return self.matrices.values(self._stiffness())

    def modules(self) -> dict[str, nn.Module]:
        """The section."""
        return {"section": self.section}  # pyright: ignore[reportReturnType]

    def masses(self) -> MassPoints:
        """Particles at the ends (and middles) of the elements; they do not depend on the design."""
        return self._points

    def section_forces(self, motion: Float[Tensor, "*lanes n 6 k"]) -> Float[Tensor, "*lanes m 6 k"]:
        """(N, V_y, V_z, T, M_y, M_z) of the section at the end of each element, about its own axes, for k motions."""
        line = self.matrices.end_forces(self._stiffness(), motion)
        return torch.linalg.inv(self._to_line) @ line

    def _stiffness(self) -> Float[Tensor, "*lanes m 6 6"]:
        return self._to_line @ self.section.stiffness()[..., None, :, :] @ self._to_line.mT


def _transforms(
    offset: Sequence[float] | Tensor, twist: float | Sequence[float] | Tensor, count: int, members: Tensor
) -> Float[Tensor, "m 6 6"]:
    at, turn = torch.as_tensor(offset, dtype=torch.float64), torch.as_tensor(twist, dtype=torch.float64)
    if at.shape not in ((2,), (count, 2)):
        raise InputError(f"offset has shape {tuple(at.shape)}; allowed: [2], or one for each element [{count}, 2]")
    if turn.shape not in ((), (count,)):
        raise InputError(f"twist has shape {tuple(turn.shape)}; allowed: one angle, or one for each element [{count}]")
    if at.ndim == 1 and turn.ndim == 0:
        return line_transform(at, float(turn))[None]
    at, turn = at.expand(count, 2)[members], turn.expand(count)[members]
    return torch.stack([line_transform(a, float(t)) for a, t in zip(at, turn, strict=True)])
