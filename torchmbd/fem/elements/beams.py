"""Part of an assembly: beams of one section on some elements of a line.

Checked in tests/fem/elements/test_beams.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.errors import InputError, unknown
from torchmbd.fem.elements.beam import BeamMatrices, Line
from torchmbd.fem.elements.beam_line import present_nodes, varying_nodes
from torchmbd.fem.elements.beam_section import BeamSection, definite_stiffness, free_strain_of, line_transform
from torchmbd.fem.elements.geometric import StressedCells
from torchmbd.fem.elements.part import CHANGES, MassPoints
from torchmbd.fem.elements.plates import MASSES
from torchmbd.math.checked_numbers import reals

#: Stations of a twisted element or an arc: its flexibility is exact to 1e-10 up to a quarter turn.
TURNING = 8


class Beams:
    """One section on elements of a line (default: all).

    section       a Section or GivenSection; its parameters are the design
    orientation   the section's y-axis in mesh axes, projected across each element: [3], or one for each [m, 3]
    offset        of the section's origin from the line of the nodes, along the beam's y and z [m]: [2], or [m, 2]
    twist         of the section's y-axis from `orientation`, about the beam's axis [rad]: one, one for each element [m], or
                  those at the start and the end of each [m, 2]; between them it grows evenly
    mass          "lumped", half of each element at its ends; "consistent", with linear shape functions, for comparison
    elements      indices of the elements that are made of it; orientation, offset, twist count all elements of the mesh
    """

    def __init__(
        self,
        mesh: Line,
        section: BeamSection,
        orientation: Sequence[float] | Tensor = (0.0, 1.0, 0.0),
        offset: Sequence[float] | Tensor = (0.0, 0.0),
        twist: float | Sequence | Tensor = 0.0,
        elements: Sequence[int] | Tensor | None = None,
        mass: str = "lumped",
    ) -> None:
        if mass not in MASSES:
            raise unknown("mass", mass, MASSES)
        if not (isinstance(section, nn.Module) and isinstance(section, BeamSection)):
            raise InputError("section", section, "a Section or a GivenSection")
        self.section = section
        self.arguments = orientation, offset, twist, mass
        count, at, turn = len(mesh.elements), reals("offset", offset), reals("twist", twist)
        if at.shape not in ((2,), (count, 2)):
            raise InputError(
                "offset",
                at,
                f"must have shape [2], or one for each element [{count}, 2]",
                state=f"has shape {tuple(at.shape)}",
            )
        if turn.shape not in ((), (count,), (count, 2)):
            allowed = f"one angle, one for each element [{count}], or two, at its start and end [{count}, 2]"
            raise InputError("twist", turn, allowed, state=f"has shape {tuple(turn.shape)}")
        members = slice(None) if elements is None else torch.as_tensor(elements)
        at = (at[None] if at.ndim == 1 else at[members])[:, None]  # [m, 1, 2]; m is 1 where all elements have the same
        turn = turn[None, None] if turn.ndim == 0 else turn[members].reshape(-1, turn[0].numel())  # [m, 1 or 2]
        turning = turn.shape[1] == 2 or mesh.middles is not None
        self._line = mesh
        self.matrices = BeamMatrices(mesh, orientation, elements, TURNING if turning else 2)
        self.pattern = self.matrices.pattern
        self._to_line = line_transform(at, _along(turn, self.matrices.stations))
        start_end_middle = torch.tensor([0.0, 1.0, 0.5], dtype=torch.float64)
        places = line_transform(at, _along(turn, start_end_middle))
        self._to_ends = places[:, :2]
        self._massive, self._consistent = places if mass == "consistent" else places[:, :2], mass == "consistent"
        with torch.no_grad():
            self._points = self._particles()

    def on_line(self, line: Line, elements: Sequence[int]) -> Beams | None:
        """Return the part on a line of only these elements, in this order; None where none of them belongs to it."""
        element_set = set(self.matrices.members.tolist())
        members = [k for k, e in enumerate(elements) if e in element_set]
        count = len(self._line.elements)
        orientation, offset, twist, mass = self.arguments

        def rows(x: Any, dim: int) -> Tensor:
            x = reals("given", x)
            return x[list(elements)] if x.ndim > dim and len(x) == count else x

        if not members:
            return None
        return Beams(line, self.section, rows(orientation, 1), rows(offset, 1), rows(twist, 0), members, mass)

    def values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, "*lanes nnz"]:
        """K of the present design, or only some entries of it."""
        values = self._present.values(self._stiffness())
        return values if entries is None else values[..., entries]

    def modules(self) -> dict[str, nn.Module]:
        """The section."""
        return {"section": self.section}  # pyright: ignore[reportReturnType]

    def masses(self) -> MassPoints:
        """Particles at the ends (and middles) of the elements."""
        return self._particles() if self.section.mass_varies or varying_nodes(self._line) else self._points

    @property
    def lengths(self) -> Float[Tensor, "*lanes m"]:
        """Lengths of the elements in the present design [m]."""
        return self._present.length

    @property
    def _present(self) -> BeamMatrices:
        """The elements in the present design."""
        return self.matrices.with_nodes(present_nodes(self._line)) if varying_nodes(self._line) else self.matrices

    def _particles(self) -> MassPoints:
        at_line = self._massive @ self.section.mass()[..., None, None, :, :] @ self._massive.mT
        ends, arm, mass = self._present.particles(at_line, self._consistent)
        return MassPoints(ends, mass, torch.zeros_like(mass), arm)

    def section_forces(self, motion: Float[Tensor, "*lanes n 6 k"]) -> Float[Tensor, "*lanes m 2 6 k"]:
        """(N, V_y, V_z, T, M_y, M_z) at start and end of each element, about the section's own axes, for k motions."""
        return torch.linalg.inv(self._to_ends) @ self._present.forces(self._stiffness(), motion)

    changes: ClassVar[tuple[str, ...]] = tuple(CHANGES)

    def expansion_forces(self, change: str) -> Float[Tensor, "*lanes n 6"]:
        """Forces and moments on all nodes that cause the free expansion by a unit change."""
        return self._present.on_nodes(self._held(change))

    def held_forces(self, change: str) -> Float[Tensor, "*lanes m 2 6"]:
        """Section forces at start and end of each element that cause the free strains by a unit change, as `section_forces`."""
        forces = self._present.along(self._held(change)[..., None])
        return (torch.linalg.inv(self._to_ends) @ forces)[..., 0]

    def _held(self, change: str) -> Float[Tensor, "*lanes m 6"]:
        strain = free_strain_of(self.section, change)[..., None, None, :, None]
        return self._present.held_forces(self._stiffness(), (torch.linalg.inv(self._to_line).mT @ strain)[..., 0])

    def stressed(self, motion: Float[Tensor, "*lanes n 6 k"], change: str | None = None) -> list[StressedCells]:
        """The elements under the section forces of k motions, less those of the free strains of a unit change."""
        return self._present.stressed(self._stiffness(), motion, None if change is None else self._held(change))

    @property
    def ends(self) -> Int[Tensor, "places 2"]:
        """Element and end (0 start, 1 end) of all section forces, in their order."""
        return torch.cartesian_prod(self.matrices.members, torch.arange(2))

    def _stiffness(self) -> Float[Tensor, "*lanes m g 6 6"]:
        return self._to_line @ definite_stiffness(self.section)[..., None, None, :, :] @ self._to_line.mT


def _along(twist: Float[Tensor, "m e"], place: Float[Tensor, " g"]) -> Float[Tensor, "m g"]:
    """Twist at parts of the length of each element."""
    return twist[:, :1] + place * (twist[:, -1:] - twist[:, :1])
