"""Stiffness of a laminated plate or faceted shell: linear in the laminate's 21 entries, but for inner forces of the cells.

    K(b) = sum_i s_i(b) K_i (+ inner forces),      s = laminate.entries() [..., 21],      K_i = sum_e sum_points weight E' C_i E

C_i     the pattern of entry i in the 8 x 8 law (N, M, Q) = C (eps, kappa, gamma)
E       strains of the cell (strains.py, shell_elements.py): triangles and quadrilaterals, mixed as the mesh mixes them
basis   values of all K_i on one sparsity pattern, made once per mesh            [21, nnz]
inner   membrane forces that vary over a quadrilateral (inner_forces.py): a small matrix for each cell and design

So a new design of triangles costs one product `entries @ basis`, whatever the mesh, and derivatives in the design are exact.
Two numbers enter E from the laminate: mean Poisson's ratio and shear length (IsotropicMean). They are constants under
any change of ply angle. When *thickness* is a design variable they stay those of the laminate given here: still a
converging element with the exact gradient of what it computes, tuned to a neighboring thickness. A fifth more or less
moves frequencies of a mesh by 0.2 % beside the element tuned anew, half or twice the thickness by 0.5 and 2 %; make the
body anew after larger changes.
Global freedom index = 6 * node + freedom (u1 u2 u3 phi1 phi2 phi3), in mesh axes, SI units.
Source: eqs. (10)-(13) of the paper; the elements name their own.
Checked in tests/elements/test_plate_*.py, tests/elements/test_thickness.py, tests/convergence/test_plate*.py,
tests/validation/test_*plate*.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.elements.facet import Facets, facets
from torchmbd.elements.inner_forces import CellForces
from torchmbd.elements.shell_elements import ELEMENTS
from torchmbd.elements.strains import Strains
from torchmbd.errors import InputError
from torchmbd.materials import ENTRIES, IsotropicMean, Laminate, LaminateStiffness
from torchmbd.mesh import Mesh, directed_area
from torchmbd.numerics.linear_map import mapped
from torchmbd.numerics.sparse import Pattern, SparseMatrix

_FIRST_ROW = {"A": (0, 0), "B": (0, 3), "D": (3, 3), "As": (6, 6)}


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one kind: their corners [m, c], planes and strains."""

    corners: Int[Tensor, "m c"]
    facets: Facets
    strains: Strains


class _Picked(NamedTuple):
    """Some numbers of K, a linear map of entries and of the laws of inner forces (linear_map.py).

    basis   columns of these numbers, and of more [21, columns]
    inner   of the kinds that have inner forces
    places  the column of every number of their cells
    result  which columns are asked for
    """

    basis: Float[Tensor, "21 columns"]
    inner: list[CellForces]
    places: list[Int[Tensor, " numbers"]]
    result: slice | Int[Tensor, " k"]

    def __call__(self, *x: Tensor) -> Float[Tensor, "lanes columns"]:
        """Of entries [lanes, 21] and laws [lanes, m, 13, 13]; in memory lanes come last."""
        if not self.inner:
            return x[0] @ self.basis
        values = self.basis.mT @ x[0].mT
        for own, place, law in zip(self.inner, self.places, x[1:], strict=True):
            values.index_add_(0, place, own.numbers(law))
        return values.mT

    def adjoint(self, y: Float[Tensor, "lanes columns"]) -> tuple[Tensor, ...]:
        """Back to entries and laws."""
        laws = (own.adjoint(y.mT[place]) for own, place in zip(self.inner, self.places, strict=True))
        return y @ self.basis.mT, *laws


class PlateMatrices:
    """What a mesh contributes to stiffness and mass, made once per mesh.

    pattern   where K is not zero
    basis     [21, nnz]: K values = entries @ basis, and inner forces; `...` lanes of entries give [..., nnz]
    area      [n] tributary area of each node [m2]: lumped mass = mass_per_area * area,
              nodal rotary inertia = rotary_inertia_per_area * area
    kinds     the cells of each kind that there are
    members   the numbers of the cells, by kind

    laminate    the laminate, of which only the mean properties enter here; or these
    direction   the laminate's x-axis in mesh axes, projected into each cell: [3], or one for each cell of the mesh [m, 3]
    cells       numbers of the cells that are made of it; None: all of the mesh
    """

    def __init__(
        self,
        mesh: Mesh,
        laminate: Laminate | IsotropicMean,
        direction: Sequence[float] | Tensor = (1.0, 0.0, 0.0),
        cells: Sequence[int] | Tensor | None = None,
    ) -> None:
        if not isinstance(mesh, Mesh):
            raise InputError(f"mesh of a plate is {mesh!r}; allowed: a Mesh, such as mbd.mesh.rectangle(...)")
        if not isinstance(laminate, (Laminate, IsotropicMean)):
            raise InputError(f"laminate of a plate is {laminate!r}; allowed: a Laminate")
        self.mesh = mesh
        chosen = torch.arange(mesh.cell_count) if cells is None else torch.as_tensor(cells, dtype=torch.long)
        self.mean = laminate if isinstance(laminate, IsotropicMean) else IsotropicMean.of(laminate)
        found = []
        for kind, corners in mesh.cells.items():
            own = chosen - mesh.first(kind)
            own = own[(own >= 0) & (own < len(corners))]
            if len(own):
                found.append((kind, own, facets(mesh, direction, own, kind)))
        self.members = torch.cat([mesh.first(kind) + own for kind, own, _ in found])
        self.area = self._tributary()
        corners = [mesh.cells[kind][own] for kind, own, _ in found]
        self.pattern, slots = _block_pattern(corners, len(mesh.nodes))
        self.kinds = {
            kind: Cells(at, plane, ELEMENTS[kind](plane, self.mean))
            for (kind, _, plane), at in zip(found, corners, strict=True)
        }
        self.basis = self.area.new_zeros(len(ENTRIES), self.pattern.nnz)
        inner, places = [], []
        for own, slot in zip(self.kinds.values(), slots, strict=True):
            _add_laws(self.basis, own.strains, slot)
            if own.strains.forces is not None:
                inner.append(CellForces(own.strains.forces))
                places.append(slot.flatten())
        self._whole = self._picked = _Picked(self.basis, inner, places, slice(None))
        self._chosen: Tensor | None = None

    @property
    def axes(self) -> Float[Tensor, "m 3 3"]:
        """Axes of the laminate in each cell, rows, mesh axes."""
        return torch.cat([own.facets.axes for own in self.kinds.values()])

    @property
    def pieces(self) -> tuple[Int[Tensor, "pieces 3"], Float[Tensor, " pieces"], Float[Tensor, "pieces 3"]]:
        """Triangles that cover the cells (mesh.py), the area that each counts with [m2], and its cell's normal."""
        nodes, share, cell = self.mesh.pieces
        chosen = torch.isin(cell, self.members)
        nodes, share = nodes[chosen], share[chosen]
        return nodes, share * directed_area(self.mesh.nodes[nodes]).norm(dim=1), self.mesh.normals[cell[chosen]]

    def stiffness(self, entries: Float[Tensor, "*lanes 21"]) -> SparseMatrix:
        """Return K of one laminate or of a batch."""
        if entries.shape[-1] != len(ENTRIES):
            raise InputError(f"entries has shape {tuple(entries.shape)}; allowed: [..., {len(ENTRIES)}]")
        return SparseMatrix(self.pattern, self.values(entries))

    def values(
        self, entries: Float[Tensor, "*lanes 21"], chosen: Int[Tensor, " k"] | None = None
    ) -> Float[Tensor, "*lanes nnz"]:
        """Return the numbers of K on the pattern, or only chosen ones: where they are is found once."""
        if chosen is not None and chosen is not self._chosen:
            self._chosen, self._picked = chosen, self._pick(chosen)
        picked = self._whole if chosen is None else self._picked
        numbers = entries.reshape(-1, len(ENTRIES))
        law = LaminateStiffness.of(numbers)
        values = mapped(picked, numbers, *(own.law(law.A, law.B) for own in picked.inner))
        return values[:, picked.result].reshape(*entries.shape[:-1], -1)

    def _pick(self, chosen: Int[Tensor, " k"]) -> _Picked:
        """What makes the chosen numbers of K; others of a cell go to a last place that is left out."""
        distinct, again = torch.unique(chosen, return_inverse=True)
        place = torch.full((self.pattern.nnz,), len(distinct))
        place[distinct] = torch.arange(len(distinct))
        basis = torch.nn.functional.pad(self.basis[:, distinct], (0, 1 if self._whole.inner else 0))
        same = torch.equal(again, torch.arange(len(distinct)))
        places = [place[own] for own in self._whole.places]
        return _Picked(basis, self._whole.inner, places, slice(len(distinct)) if same else again)

    def section_strains(self, displacements: Float[Tensor, "*lanes n 6 k"]) -> Float[Tensor, "*lanes m 8 k"]:
        """Return eps, kappa, gamma at the middle of each cell for k fields of nodal displacements, such as modes."""
        found = []
        for own in self.kinds.values():
            at = displacements[..., own.corners, :, :].flatten(-3, -2)
            found.append(torch.einsum("msf,...mfk->...msk", own.strains.center, at))
        return torch.cat(found, dim=-3)

    def lumped_mass(
        self, mass_per_area: Float[Tensor, "*lanes"], rotary_inertia_per_area: Float[Tensor, "*lanes"]
    ) -> Float[Tensor, "*lanes freedoms"]:
        """Diagonal of the mass matrix: m, m, m, mu, mu, mu of each node [kg, kg m2], eqs. (2) and (13).

        Of laminates whose mass lies about the middle surface (`laminate.centered`); others: `Plates`.
        """
        per_area = torch.stack([mass_per_area] * 3 + [rotary_inertia_per_area] * 3, dim=-1)
        return (self.area[:, None] * per_area[..., None, :]).flatten(-2)

    def _tributary(self) -> Float[Tensor, " n"]:
        nodes, area, _ = self.pieces
        thirds = (area / 3.0)[:, None].expand(-1, 3).reshape(-1)
        return area.new_zeros(len(self.mesh.nodes)).index_add(0, nodes.flatten(), thirds)


def _block_pattern(kinds: list[Tensor], n: int) -> tuple[Pattern, list[Tensor]]:
    """Pattern of 6 x 6 blocks between nodes that share a cell, and for each kind the slots of every cell's numbers.

    The place of a number follows from the place of its block, so only the node pairs are sorted, not all coordinates.
    """
    pairs = [(corners[:, :, None] * n + corners[:, None, :]).flatten() for corners in kinds]
    pair, block = torch.unique(torch.cat(pairs), sorted=True, return_inverse=True)
    row, col = torch.div(pair, n, rounding_mode="floor"), pair % n
    degree = torch.bincount(row, minlength=n)
    first = degree.cumsum(0) - degree
    place = torch.arange(len(pair)) - first[row]  # of the block in its row of blocks
    six = torch.arange(6)
    # [block, r, c]: all blocks of the rows before, then r whole rows of this row of blocks, then the blocks before.
    start = 36 * first[row, None, None] + 6 * degree[row, None, None] * six[:, None]
    slots = start + 6 * place[:, None, None] + six
    rows, cols = torch.empty(slots.numel(), dtype=torch.long), torch.empty(slots.numel(), dtype=torch.long)
    rows[slots.flatten()] = (6 * row[:, None, None] + six[:, None]).expand_as(slots).flatten()
    cols[slots.flatten()] = (6 * col[:, None, None] + six).expand_as(slots).flatten()
    cells = []
    for corners, own in zip(kinds, block.split([len(p) for p in pairs]), strict=True):
        m, c = corners.shape
        cells.append(slots[own].reshape(m, c, c, 6, 6).transpose(2, 3).reshape(m, 6 * c, 6 * c))
    return Pattern(rows, cols, 6 * n), cells


def _add_laws(basis: Float[Tensor, "21 nnz"], strains: Strains, slot: Int[Tensor, "m f f"]) -> None:
    """Add sum_points weight E' C_i E of every entry i to its row."""
    weighted = strains.at * strains.weight[..., None, None]
    slots = slot.flatten()
    for values, (name, i, j) in zip(basis, ENTRIES, strict=True):
        p0, q0 = _FIRST_ROW[name]
        pairs = sorted({(p0 + i, q0 + j), (p0 + j, q0 + i)})  # two, where i differs from j
        left, right = [p for p, _ in pairs], [q for _, q in pairs]
        element = weighted[:, :, left].flatten(1, 2).mT @ strains.at[:, :, right].flatten(1, 2)
        if name == "B":  # stands in C twice, above and below the diagonal
            element = element + element.mT
        values.index_add_(0, slots, element.flatten())
