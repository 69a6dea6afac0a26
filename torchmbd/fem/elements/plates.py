"""Parts of an assembly: laminated plates on some cells of a mesh.

mass of a plate     "lumped": a third of each triangle at its corners, eqs. (2) and (13);
                    "consistent": at the middles of its sides, that is with linear shape functions, for comparison
                    (quadrilaterals: the mean of both ways to cut them)

    m = rho_0 area     at the height z_s = rho_1 / rho_0 along the normal n     mu = (rho_2 - rho_0 z_s^2 n.n) area

rho_0, rho_1, rho_2   moments of the laminate's density through its thickness [kg/m2, kg/m, kg]
n                     mean of the normals of the cells around the point, weighted with their areas (flat plate: n.n = 1)

So translations are coupled with rotations by rho_1, and rotations have the inertia rho_2 about the middle surface.
Checked in tests/fem/elements/test_assembly.py, tests/multibody/bodies/test_mass_off_middle.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.errors import InputError, unknown
from torchmbd.fem.elements.facet import cell_directions
from torchmbd.fem.elements.geometric import StressedCells
from torchmbd.fem.elements.part import MassPoints, Part
from torchmbd.fem.elements.plate import PlateMatrices
from torchmbd.fem.elements.shell_geometric import stressed_shells
from torchmbd.fem.materials import Laminate
from torchmbd.fem.materials.isotropic_mean import present_mean
from torchmbd.fem.mesh import MaterialAxes, Mesh
from torchmbd.fem.mesh.material_axes import rule_of
from torchmbd.math.distinct_rows import distinct_rows
from torchmbd.math.forward_mode import jvp
from torchmbd.math.sparse import Pattern

MASSES = ("lumped", "consistent")


class Plates:
    """One laminate on cells of a mesh (default: all), or several of the same plies, each on its own cells.

    direction   the laminate's x-axis in mesh axes: [3], one for each cell of the mesh [m, 3], or a rule (mbd.mesh.around), also
                as a mapping, {"around": {"axis": [0, 0, 1]}}
    cells       numbers of the cells that are made of it
    mass        "lumped" or "consistent"
    zones       which of several laminates each of the cells is made of
    """

    changes: ClassVar[tuple[str, ...]] = ("temperature", "gradient", "moisture")

    def __init__(
        self,
        mesh: Mesh,
        laminate: Laminate | Sequence[Laminate],
        direction: Sequence[float] | Tensor | MaterialAxes | Mapping[str, Any] = (1.0, 0.0, 0.0),
        cells: Sequence[int] | Tensor | None = None,
        mass: str = "lumped",
        zones: Int[Tensor, " cells"] | None = None,
    ) -> None:
        if mass not in MASSES:
            raise unknown("mass", mass, MASSES)
        if isinstance(direction, Mapping):
            direction = rule_of(direction)
        if isinstance(direction, MaterialAxes):
            direction = direction.of_cells(mesh)
        several = isinstance(laminate, Sequence)
        self.laminates, self.mass, self.direction = tuple(laminate) if several else (laminate,), mass, direction
        if not isinstance(mesh, Mesh):
            raise InputError("mesh", mesh, "a Mesh, such as mbd.mesh.rectangle(...)", noun="mesh of a plate")
        for member in self.laminates:
            if not isinstance(member, Laminate):
                raise InputError("laminate", member, "a Laminate", noun="laminate of a plate")
        self.mesh, self._zones = mesh, zones
        self.cells = torch.arange(mesh.cell_count) if cells is None else torch.as_tensor(cells, dtype=torch.long)
        field = self.laminates[0].field
        if field is not None:
            self._zones = field.zones(mesh, self.cells)

    def on_mesh(self, mesh: Mesh, parents: Int[Tensor, " all"]) -> Plates:
        """The same plies, of no field, on a finer mesh, each cell of which lies in the cell of its number in `parents`."""
        members = torch.isin(parents, self.cells).nonzero()[:, 0]
        zones = None
        if self._zones is not None:
            place = torch.empty(self.mesh.cell_count, dtype=torch.long).index_copy(0, self.cells, self._zones)
            zones = place[parents[members]]
        direction = torch.as_tensor(self.direction, dtype=torch.float64)
        direction = direction[parents] if direction.dim() > 1 else direction
        laminates = self.laminates if zones is not None else self.laminates[0]
        return Plates(mesh, laminates, direction, members, self.mass, zones)

    @property
    def laminate(self) -> Laminate:
        """The only laminate, or all of them as one."""
        first = self.laminates[0]
        alone = self._zones is None or first.field is not None
        return first if alone else Laminate.stacked(self.laminates)

    @property
    def merge_key(self) -> tuple:
        """Key that is equal for plates that `merge_plates` may join to one part."""
        return id(self.mesh), self.mass, *(laminate.merge_key for laminate in self.laminates)

    @cached_property
    def matrices(self) -> PlateMatrices:
        """Stiffness and areas of the cells."""
        return PlateMatrices(self.mesh, self.laminates[0].mean_laminate, self.direction, self.cells, self._zones)

    def fibers(self) -> list[Float[Tensor, "cells 3"]]:
        """Directions of the fibers of each layer, from the bottom: unit vectors in the cells `matrices.members`, mesh axes."""
        matrices, directions = self.matrices, []
        for theta in self.laminate.layer_angles.detach().unbind(-1):
            angle = (theta[matrices.zones] if theta.ndim else theta)[..., None]
            directions.append(angle.cos() * matrices.axes[:, 0] + angle.sin() * matrices.axes[:, 1])
        return directions

    @property
    def pattern(self) -> Pattern:
        """Where K is not zero."""
        return self.matrices.pattern

    def values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, "*lanes nnz"]:
        """K of the present design, or only some entries of it."""
        laminate = self.laminate
        return self.matrices.values(laminate.entries(), entries, self.matrices.moved_mean(laminate))

    @property
    def loses(self) -> bool:
        """True if a ply has a loss factor."""
        return any(laminate.loses for laminate in self.laminates)

    def loss_values(self, entries: Int[Tensor, " k"] | None) -> Float[Tensor, "*lanes nnz"]:
        """The derivative of K where the moduli of each ply grow by its loss factor: those of complex moduli E (1 + i eta)."""
        laminate = self.laminate

        def grown(share: Tensor) -> Tensor:
            stiffer = laminate.stiffened(1.0 + share * laminate.loss_factors)
            return self.matrices.values(stiffer.entries(), entries, present_mean(stiffer))

        none = torch.zeros((), dtype=torch.float64)
        by: Any = jvp(grown, (none,), (torch.ones_like(none),))
        return by[1]

    def stressed(self, motion: Float[Tensor, "*lanes n 6 k"], change: str | None = None) -> list[StressedCells]:
        """The cells under the membrane forces of k motions, less those of the free strains of a unit change."""
        laminate = self.laminate
        held = None if change is None else laminate.held_expansion(**{change: 1.0}).force
        return stressed_shells(self.matrices, laminate.entries(), motion, self.matrices.moved_mean(laminate), held)

    def expansion_forces(self, change: str) -> Float[Tensor, "*lanes n 6"]:
        """Forces and moments on all nodes that cause the free expansion by a unit change."""
        laminate = self.laminate
        held = laminate.held_expansion(**{change: 1.0})
        return self.matrices.expansion_forces(
            torch.cat([held.force, held.moment], -1), self.matrices.moved_mean(laminate)
        )

    def modules(self) -> dict[str, nn.Module]:
        """The laminate."""
        return {"laminate": self.laminates[0]}

    @cached_property
    def _points(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _points(self.matrices, self.mass == "consistent")

    def masses(self) -> MassPoints:
        """Mass points of the present design."""
        ends, zone, area, normal = self._points
        laminate = self.laminate

        def of_points(x: Tensor) -> Tensor:
            return x[..., None] if self._zones is None else x[..., zone]

        mass, rotary = (of_points(x) * area for x in (laminate.mass_per_area, laminate.rotary_inertia_per_area))
        if laminate.centered:
            return MassPoints(ends, mass, rotary)
        height = of_points(laminate.first_moment_per_area / laminate.mass_per_area)
        arm = height[..., None] * normal
        return MassPoints(ends, mass, rotary - mass * (arm * arm).sum(-1), arm)


def merge_plates(parts: Mapping[str, Part]) -> dict[str, Part]:
    """Join plates whose laminates differ in their angles only: a design then costs little more than that of one laminate."""
    groups: dict[Any, dict[str, Any]] = {}
    for name, part in parts.items():
        groups.setdefault(part.merge_key if isinstance(part, Plates) else id(part), {})[name] = part
    return {name: part for group in groups.values() for name, part in _joined(group).items()}


def _joined(group: dict[str, Any]) -> dict[str, Part]:
    """Join plates of one merge_key to one part; plates that share a cell stay as they are."""
    first, *others = group.values()
    if not others:
        return group
    cells = [part.cells for part in (first, *others)]
    if len(torch.cat(cells).unique()) < sum(map(len, cells)):
        return group
    direction = torch.zeros(first.mesh.cell_count, 3, dtype=torch.float64)
    for part in (first, *others):
        direction[part.cells] = cell_directions(first.mesh, part.direction)[part.cells]
    zones = torch.repeat_interleave(torch.tensor([len(x) for x in cells]))
    laminates = [part.laminates[0] for part in (first, *others)]
    return {next(iter(group)): Plates(first.mesh, laminates, direction, torch.cat(cells), first.mass, zones)}


def _points(matrices: PlateMatrices, consistent: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Node pairs of the mass points, the laminate and the area of each, and the mean normal there."""
    corners, area, normals, zone = matrices.covering_triangles
    other = corners.roll(-1, dims=1) if consistent else corners
    pairs = torch.stack([corners, other], dim=-1).flatten(0, 1).sort(dim=1).values
    every = torch.cat([pairs, zone.repeat_interleave(3)[:, None]], 1)
    example, place = distinct_rows(every)
    points = every[example]
    thirds = (area / 3.0).repeat_interleave(3)
    whole = thirds.new_zeros(len(points)).index_add(0, place, thirds)
    normal = torch.zeros(len(points), 3, dtype=area.dtype)
    normal.index_add_(0, place, thirds[:, None] * normals.repeat_interleave(3, dim=0))
    return points[:, :2], points[:, 2], whole, normal / whole[:, None]
