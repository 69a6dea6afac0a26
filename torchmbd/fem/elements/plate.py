"""Stiffness of a laminated plate or faceted shell: linear in the laminate's 21 entries, but for inner forces of the cells.

    K(b) = sum_cells K_cell(s(b))      s = laminate.entries() [..., 21]

Cells of one shape and one laminate have one matrix (cell_stiffness.py): a new design costs their products and one sum over
all cells, and derivatives in the design are exact.
Three numbers enter the strains of a cell (strains.py, cell_stiffness.py) from the laminate: mean Poisson's ratio, shear and
bending length (IsotropicMean). They are constants under any change of ply angle. Where thicknesses or numbers of plies move
or are differentiated, the strains are made anew in each design (`moved_mean`), as functions of these.
Ply strains and stresses are maps of the laminate (fem/materials/ply_maps.py) times the section strains at the middle of each
cell, where the element's are best. Both are linear in the displacements, which may be modes: `stress = basis.stress @ w` is
then one product for all times of modal coordinates w.
Index of a degree of freedom: 6 * node + component (u1 u2 u3 phi1 phi2 phi3), in mesh axes, SI units. Differentiable, forward
and reverse, in the laminate's parameters and in the displacements, with lanes.
Source: eqs. (10)-(13) of the paper; the elements name their own.
Checked in tests/fem/elements/test_plate_*.py, tests/fem/elements/test_thickness.py, tests/fem/elements/test_ply_recovery.py,
tests/convergence/test_plate*.py, tests/validation/test_*plate*.py, tests/validation/test_ply_stresses.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements.cell_blocks import CellBlocks
from torchmbd.fem.elements.cell_stiffness import ELEMENTS, CellStiffness, distinct_shapes
from torchmbd.fem.elements.facet import Facets, facets
from torchmbd.fem.elements.strains import ShearRecovery, Strains
from torchmbd.fem.materials import ENTRIES, IsotropicMean, Laminate, LaminateStiffness, ply_maps, present_mean
from torchmbd.fem.mesh import Mesh, directed_area
from torchmbd.math.distinct_rows import distinct_rows
from torchmbd.math.gradients import in_transform, is_differentiated, untransformed
from torchmbd.math.linear_map import Sums, apply_linear
from torchmbd.math.sparse import Pattern, SparseMatrix

_SAME = 1e-9  # of constants: what rounding makes of a mean


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one kind: their corners and planes, the shape of each, and planes and strains of the shapes."""

    kind: str
    corners: Int[Tensor, "m c"]
    facets: Facets
    shape: Int[Tensor, " m"]
    shapes: Facets
    strains: Strains

    @classmethod
    def of(cls, kind: str, corners: Int[Tensor, "m c"], plane: Facets, mean: IsotropicMean) -> Cells:
        """Cells in their planes."""
        example, shape = distinct_shapes(plane)
        shapes = Facets(*(x[example] for x in vars(plane).values()))
        return cls(kind, corners, plane, shape, shapes, ELEMENTS[kind](shapes, mean))

    def moved(self, cell: CellStiffness, constants: Float[Tensor, "lanes z 3"]) -> Strains:
        """Strains of all variants of a cell under other constants of the laminates (`present_mean`), [lanes variants, ...]."""
        plane = (x[cell.shape] for x in vars(self.shapes).values())
        lanes = len(constants)
        of_variants = constants[:, cell.laminate].flatten(0, 1).unbind(-1)
        repeated = Facets(*(x.repeat(lanes, *[1] * (x.dim() - 1)) for x in plane))
        return ELEMENTS[self.kind](repeated, IsotropicMean(*of_variants))


class _Numbers(NamedTuple):
    """The numbers of K, a linear map of entries and of the laws of inner forces (linear_map.py)."""

    cells: list[CellStiffness]
    sums: Sums

    def __call__(self, *x: Tensor) -> Float[Tensor, "lanes numbers"]:
        """Of entries [lanes, laminates, 21] and laws [lanes, variants, 13, 13]."""
        laws = iter(x[1:])
        return self.sums(torch.cat([cell(x[0], *(next(laws) for _ in range(cell.laws))) for cell in self.cells], 1))

    def adjoint(self, y: Float[Tensor, "lanes numbers"]) -> tuple[Tensor, ...]:
        """Return the adjoint: cotangents of entries and laws from those of the numbers."""
        parts = self.sums.adjoint(y)[0].split([cell.numbers for cell in self.cells], 1)
        cotangents = [cell.adjoint(part) for cell, part in zip(self.cells, parts, strict=True)]
        return torch.stack([entries for entries, *_ in cotangents]).sum(0), *(
            law for _, *laws in cotangents for law in laws
        )


class PlateMatrices:
    """Stiffness and tributary areas of the cells of a mesh, computed once per mesh but for the laminate.

    area      [n] tributary area of each node [m2]: lumped mass = mass_per_area * area,
              nodal rotary inertia = rotary_inertia_per_area * area
    kinds     the cells of each kind that there are
    members   the numbers of the cells, by kind
    zones     the laminate of each of these

    laminate    the laminate, of which only the mean properties enter here; or these
    direction   the laminate's x-axis in mesh axes, projected into each cell: [3], or one for each cell of the mesh [m, 3]
    cells       numbers of the cells that are made of it; None: all of the mesh
    zones       which of several laminates, of the same mean, each of these cells is made of; None: one laminate
    """

    def __init__(
        self,
        mesh: Mesh,
        laminate: Laminate | IsotropicMean,
        direction: Sequence[float] | Tensor = (1.0, 0.0, 0.0),
        cells: Sequence[int] | Tensor | None = None,
        zones: Int[Tensor, " cells"] | None = None,
    ) -> None:
        if not isinstance(mesh, Mesh):
            raise InputError("mesh", mesh, "a Mesh, such as mbd.mesh.rectangle(...)", noun="mesh of a plate")
        if not isinstance(laminate, (Laminate, IsotropicMean)):
            raise InputError("laminate", laminate, "a Laminate", noun="laminate of a plate")
        self.mesh = mesh
        chosen = torch.arange(mesh.cell_count) if cells is None else torch.as_tensor(cells, dtype=torch.long)
        self.mean = laminate if isinstance(laminate, IsotropicMean) else IsotropicMean.of(laminate)
        self.kinds: dict[str, Cells] = {}
        members = []
        for kind, corners in mesh.cells.items():
            numbers = chosen - mesh.first_cell(kind)
            numbers = numbers[(numbers >= 0) & (numbers < len(corners))]
            if len(numbers):
                self.kinds[kind] = Cells.of(kind, corners[numbers], facets(mesh, direction, numbers, kind), self.mean)
                members.append(mesh.first_cell(kind) + numbers)
        self.members = torch.cat(members)
        self.several = zones is not None
        of_cell = chosen.new_zeros(mesh.cell_count)
        self.zones = (of_cell if zones is None else of_cell.index_copy(0, chosen, zones))[self.members]
        self.laminates = 1 + int(self.zones.max())
        nodes, area, *_ = self.covering_triangles
        thirds = (area / 3.0)[:, None].expand(-1, 3).flatten()
        self.area = area.new_zeros(len(mesh.nodes)).index_add(0, nodes.flatten(), thirds)
        # for each choice of entries, of a body and its load cases
        self._maps: list[tuple[Tensor | None, _Numbers]] = []
        self._unmoved: tuple[Tensor, ...] | None = None  # what a mean that had not moved was computed from

    @property
    def numbers(self) -> int:
        """How many numbers the matrices of all shapes of cells have, for each entry of a laminate: most of the memory of a
        curved shell. It is known before they are computed."""
        strains = [group.strains.at for group in self.kinds.values()]
        return sum(len(ENTRIES) * len(x) * x.shape[-1] * (x.shape[-1] + 1) // 2 for x in strains)

    @cached_property
    def _blocks(self) -> CellBlocks:
        return CellBlocks([group.corners for group in self.kinds.values()], len(self.mesh.nodes))

    @property
    def pattern(self) -> Pattern:
        """Where K is not zero."""
        return self._blocks.pattern

    @cached_property
    def variants(self) -> list[tuple[CellStiffness, Tensor]]:
        """Of each kind: the matrices of its variants, and the variant of each cell."""
        variants = []
        laminates = self.zones.split([len(group.shape) for group in self.kinds.values()])
        for group, laminate in zip(self.kinds.values(), laminates, strict=True):
            example, variant = distinct_rows(torch.stack([group.shape, laminate], 1))
            which = torch.stack([group.shape, laminate], 1)[example]
            variants.append((CellStiffness(group.strains, which, self.laminates), variant))
        return variants

    def _map(self, entries: Tensor | None) -> _Numbers:
        """The map to chosen entries of the pattern; None: to all."""
        for choice, numbers in self._maps:
            if choice is entries:
                return numbers
        first, count = [], 0
        for cell, variant in self.variants:
            first.append(count + variant * cell.each)
            count += cell.numbers
        cells = [cell for cell, _ in self.variants]
        numbers = _Numbers(cells, self._blocks.sums(first, [cell.entry_index for cell in cells], count, entries))
        self._maps = [*self._maps[-3:], (entries, numbers)]
        return numbers

    @property
    def axes(self) -> Float[Tensor, "m 3 3"]:
        """Axes of the laminate in each cell, rows, mesh axes."""
        return torch.cat([group.facets.axes for group in self.kinds.values()])

    @property
    def covering_triangles(
        self,
    ) -> tuple[Int[Tensor, "pieces 3"], Float[Tensor, " pieces"], Float[Tensor, "pieces 3"], Int[Tensor, " pieces"]]:
        """Triangles that cover the cells (mesh.py): the area that each counts with [m2], its cell's normal and laminate."""
        nodes, share, cell = self.mesh.covering_triangles
        chosen = torch.isin(cell, self.members)
        nodes, share, cell = nodes[chosen], share[chosen], cell[chosen]
        zone = self.zones.new_zeros(self.mesh.cell_count).index_copy(0, self.members, self.zones)
        area = share * directed_area(self.mesh.nodes[nodes]).norm(dim=1)
        return nodes, area, self.mesh.normals[cell], zone[cell]

    def stiffness(self, entries: Float[Tensor, "*lanes 21"]) -> SparseMatrix:
        """Return K of one laminate or of a batch; of several laminates entries are [*lanes, laminates, 21]."""
        if entries.shape[-1] != len(ENTRIES):
            raise InputError(
                "entries", entries, f"must have shape [..., {len(ENTRIES)}]", state=f"has shape {tuple(entries.shape)}"
            )
        return SparseMatrix(self.pattern, self.values(entries))

    def moved_mean(self, laminate: Laminate) -> Float[Tensor, "*lanes 3"] | None:
        """`present_mean` where it differs from the constants of these matrices, or is differentiated; else None."""
        inputs = laminate.mean_inputs
        fixed = not any(is_differentiated(x) for x in inputs)
        if fixed and self._unmoved and all(map(torch.equal, inputs, self._unmoved)):
            return None
        mean = present_mean(laminate)
        start = torch.tensor([self.mean.poisson, self.mean.shear_length, self.mean.bending_length], dtype=mean.dtype)
        same = (untransformed(mean) - start).abs() <= _SAME * start.abs()
        varied = is_differentiated(mean)
        if varied and in_transform(mean):
            # A transform of torch.func wraps whatever is computed under it, also of numbers that it leaves alone; so these
            # are asked: all of the laminate but its angles.
            numbers = [x for name, x in laminate.named_parameters() if name.rpartition(".")[2] != "angles"]
            varied = any(
                is_differentiated(x) for x in (*numbers, getattr(laminate, "thickness", None)) if isinstance(x, Tensor)
            )
        if varied or not bool(same.all()):
            return mean
        self._unmoved = tuple(x.detach().clone() for x in inputs) if fixed else None
        return None

    def values(
        self,
        entries: Float[Tensor, "*lanes 21"],
        positions: Int[Tensor, " k"] | None = None,
        mean: Float[Tensor, "*lanes 3"] | None = None,
    ) -> Float[Tensor, "*lanes nnz"]:
        """Return the numbers of K on the pattern, or only chosen ones: where they are is found once; mean: `moved_mean`."""
        cells_to_entries = self._map(positions)
        lanes = entries.shape[: -2 if self.several else -1]
        numbers = entries.reshape(-1, self.laminates, len(ENTRIES))
        law = LaminateStiffness.of(numbers)
        if mean is not None:
            constants = self.of_lanes(mean, lanes)
            kinds = zip(self.kinds.values(), cells_to_entries.cells, strict=True)
            stiffness = torch.cat([cell.moved(group.moved(cell, constants), law) for group, cell in kinds], 1)
            return apply_linear(cells_to_entries.sums, stiffness).reshape(*lanes, -1)
        laws = [x for cell in cells_to_entries.cells for x in cell.law(law.A, law.B)]
        return apply_linear(cells_to_entries, numbers, *laws).reshape(*lanes, -1)

    def of_lanes(self, mean: Float[Tensor, "*lanes 3"], lanes: Sequence[int]) -> Float[Tensor, "flat z 3"]:
        """Constants of all laminates in so many lanes, flattened to one axis."""
        mean = mean if self.several else mean.unsqueeze(-2)
        return mean.expand(*lanes, self.laminates, 3).reshape(-1, self.laminates, 3)

    def section_strains(
        self,
        displacements: Float[Tensor, "*lanes n 6 k"],
        law: LaminateStiffness,
        mean: Float[Tensor, "*lanes 3"] | None = None,
    ) -> Float[Tensor, "*lanes m 8 k"]:
        """Return eps, kappa, gamma at the middle of each cell for k fields of nodal displacements, such as modes.

        law   of one laminate [*lanes, ...], or of several [*lanes, laminates, ...];  mean: `moved_mean`
        """
        fields = []
        zones = self.zones.split([len(group.shape) for group in self.kinds.values()])
        for group, zone, (cell, variant) in zip(self.kinds.values(), zones, self.variants, strict=True):
            at = displacements[..., group.corners, :, :].flatten(-3, -2)
            rows = self._center_rows(group, cell, variant, mean)
            strains = rows[0] @ at
            if len(rows) > 1:
                shear = ShearRecovery(*rows[1:])
                cells = LaminateStiffness(*(X[..., zone, :, :] if self.several else X.unsqueeze(-3) for X in law))
                strains = torch.cat([strains[..., :6, :], shear.strains(cells, at)], dim=-2)
            fields.append(strains)
        return torch.cat(fields, dim=-3)

    def expansion_forces(
        self, loads: Float[Tensor, "*lanes 6"], mean: Float[Tensor, "*lanes 3"] | None = None
    ) -> Float[Tensor, "*lanes n 6"]:
        """Return forces and moments on all nodes that cause the strains of these loads (N, M), constant in each cell.

        loads   of one laminate [*lanes, 6], or of several [*lanes, laminates, 6];  mean: `moved_mean`
        """
        lanes = loads.shape[: -2 if self.several else -1]
        cells = loads[..., self.zones, :] if self.several else loads[..., None, :].expand(*lanes, len(self.zones), 6)
        total = loads.new_zeros(*lanes, len(self.mesh.nodes), 6)
        parts = cells.split([len(group.shape) for group in self.kinds.values()], -2)
        for group, part, (cell, variant) in zip(self.kinds.values(), parts, self.variants, strict=True):
            if mean is None:
                rows = _membrane_and_bending(group.strains)[group.shape]
            else:
                moved = group.moved(cell, self.of_lanes(mean, mean.shape[: -2 if self.several else -1]))
                rows = _membrane_and_bending(moved)
                rows = rows.unflatten(0, (*mean.shape[: -2 if self.several else -1], -1)).index_select(-3, variant)
            forces = (rows.mT @ part[..., None])[..., 0].unflatten(-1, (-1, 6))  # [*lanes, m, corners, 6]
            total = total.index_add(-2, group.corners.flatten(), forces.flatten(-3, -2))
        return total

    def _center_rows(
        self, group: Cells, cell: CellStiffness, variant: Tensor, mean: Float[Tensor, "*lanes 3"] | None
    ) -> list[Tensor]:
        """Rows of the strains at the middle of each cell of a kind, and those of shear recovery, [*lanes, m, ..., f]."""
        if mean is None:
            return [x[group.shape] for x in (group.strains.center, *(group.strains.shear or ()))]
        lanes = mean.shape[: -2 if self.several else -1]
        moved = group.moved(cell, self.of_lanes(mean, lanes))
        rows = (x.unflatten(0, (*lanes, -1)) if lanes else x for x in (moved.center, *(moved.shear or ())))
        return [x.index_select(len(lanes), variant) for x in rows]

    def lumped_mass(
        self, mass_per_area: Float[Tensor, "*lanes"], rotary_inertia_per_area: Float[Tensor, "*lanes"]
    ) -> Float[Tensor, "*lanes freedoms"]:
        """Diagonal of the mass matrix: m, m, m, mu, mu, mu of each node [kg, kg m2], eqs. (2) and (13).

        Of laminates whose mass lies about the middle surface (`laminate.centered`); others: `Plates`.
        """
        per_area = torch.stack([mass_per_area] * 3 + [rotary_inertia_per_area] * 3, dim=-1)
        return (self.area[:, None] * per_area[..., None, :]).flatten(-2)


def _membrane_and_bending(strains: Strains) -> Float[Tensor, "m 6 f"]:
    """Integrals of the membrane strains and curvatures of every cell, as rows on its degrees of freedom."""
    # Points after the fourth have strains of drilling freedoms.
    points = strains.weight.shape[1] if strains.forces is None else 4
    return (strains.at[:, :points, :6] * strains.weight[:, :points, None, None]).sum(1)


class PlyBasis(NamedTuple):
    """Ply strains and stresses [Pa] of k displacement fields at all points, components (11, 22, 12, 13, 23).

    Points run over cells, layers (bottom to top) and faces (bottom, top), in this order; see `ply_points`.
    """

    strain: Float[Tensor, "*lanes points 5 k"]
    stress: Float[Tensor, "*lanes points 5 k"]


def ply_basis(matrices: PlateMatrices, laminate: Laminate, displacements: Float[Tensor, "*lanes n 6 k"]) -> PlyBasis:
    """Recover the plies of k fields of nodal displacements (u1 u2 u3 phi1 phi2 phi3 of each node, mesh axes)."""
    section = matrices.section_strains(displacements, laminate.stiffness(), matrices.moved_mean(laminate))
    section = section[..., :, None, None, :, :]
    cells = (lambda x: x[..., matrices.zones, :, :, :, :]) if matrices.several else (lambda x: x.unsqueeze(-5))
    strain, stress = (cells(maps) @ section for maps in ply_maps(laminate))
    return PlyBasis(strain.flatten(-5, -3), stress.flatten(-5, -3))


def held_ply_stress(matrices: PlateMatrices, laminate: Laminate, change: str) -> Float[Tensor, "*lanes points 5"]:
    """Stresses [Pa] that would cause the free strains of the plies by a unit change, at the points of a PlyBasis."""
    stress = laminate.held_expansion(**{change: 1.0}).stress
    stress = stress[..., matrices.zones, :, :, :] if matrices.several else stress.unsqueeze(-4)
    stress = stress.expand(*stress.shape[:-4], len(matrices.members), *stress.shape[-3:])
    return torch.nn.functional.pad(stress.flatten(-4, -2), (0, 2))


def ply_points(matrices: PlateMatrices, laminate: Laminate) -> Int[Tensor, "points 3"]:
    """Cell, layer from the bottom, and face (0 bottom, 1 top) of every point of a PlyBasis."""
    layers, faces = torch.arange(len(laminate.layer_plies)), torch.arange(2)
    return torch.cartesian_prod(matrices.members, layers, faces)
