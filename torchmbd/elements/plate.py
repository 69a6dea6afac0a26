"""Stiffness of a laminated plate or faceted shell, linear in the laminate's 21 entries.

    K(b) = sum_i s_i(b) K_i,      s = laminate.entries() [..., 21],      K_i = sum_e sum_points weight E' C_i E

C_i     the pattern of entry i in the 8 x 8 law (N, M, Q) = C (eps, kappa, gamma)
E       strains of the cell (strains.py, shell_elements.py): triangles and quadrilaterals, mixed as the mesh mixes them
basis   values of all K_i on one sparsity pattern, made once per mesh            [21, nnz]

So a new design costs one product `entries @ basis`, whatever the mesh, and derivatives in the design are exact.
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

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.elements.facet import Facets, facets
from torchmbd.elements.shell_elements import ELEMENTS
from torchmbd.elements.strains import Strains
from torchmbd.errors import InputError
from torchmbd.materials import ENTRIES, IsotropicMean, Laminate
from torchmbd.mesh import Mesh, directed_area
from torchmbd.numerics.sparse import Pattern, SparseMatrix

_FIRST_ROW = {"A": (0, 0), "B": (0, 3), "D": (3, 3), "As": (6, 6)}


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one kind: their corners [m, c], planes and strains."""

    corners: Int[Tensor, "m c"]
    facets: Facets
    strains: Strains


class PlateMatrices:
    """What a mesh contributes to stiffness and mass, made once per mesh.

    pattern   where K is not zero
    basis     [21, nnz]: K values = entries @ basis, `...` lanes of entries give [..., nnz]
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
        self.kinds: dict[str, Cells] = {}
        members = []
        for kind, corners in mesh.cells.items():
            own = chosen - mesh.first(kind)
            own = own[(own >= 0) & (own < len(corners))]
            if len(own):
                plane = facets(mesh, direction, own, kind)
                self.kinds[kind] = Cells(corners[own], plane, ELEMENTS[kind](plane, self.mean))
                members.append(mesh.first(kind) + own)
        self.members = torch.cat(members)
        self.area = self._tributary()
        self.pattern, slots = _block_pattern([own.corners for own in self.kinds.values()], len(mesh.nodes))
        self.basis = sum(
            (_basis(own.strains, slot, self.pattern.nnz) for own, slot in zip(self.kinds.values(), slots, strict=True)),
            start=torch.zeros(()),
        )

    @property
    def axes(self) -> Float[Tensor, "m 3 3"]:
        """Axes of the laminate in each cell, rows, mesh axes."""
        return torch.cat([own.facets.axes for own in self.kinds.values()])

    @property
    def pieces(self) -> tuple[Int[Tensor, "pieces 3"], Float[Tensor, " pieces"]]:
        """Triangles that cover the cells (mesh.py), and the area that each counts with [m2]."""
        nodes, share, cell = self.mesh.pieces
        chosen = torch.isin(cell, self.members)
        nodes, share = nodes[chosen], share[chosen]
        return nodes, share * directed_area(self.mesh.nodes[nodes]).norm(dim=1)

    def stiffness(self, entries: Float[Tensor, "*lanes 21"]) -> SparseMatrix:
        """Return K of one laminate or of a batch."""
        if entries.shape[-1] != len(ENTRIES):
            raise InputError(f"entries has shape {tuple(entries.shape)}; allowed: [..., {len(ENTRIES)}]")
        return SparseMatrix(self.pattern, entries @ self.basis)

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
        """Diagonal of the mass matrix: m, m, m, mu, mu, mu of each node [kg, kg m2], eqs. (2) and (13)."""
        per_area = torch.stack([mass_per_area] * 3 + [rotary_inertia_per_area] * 3, dim=-1)
        return (self.area[:, None] * per_area[..., None, :]).flatten(-2)

    def _tributary(self) -> Float[Tensor, " n"]:
        nodes, area = self.pieces
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


def _basis(strains: Strains, slot: Tensor, nnz: int) -> Float[Tensor, "21 nnz"]:
    weighted = strains.at * strains.weight[..., None, None]
    basis = weighted.new_zeros(len(ENTRIES), nnz)
    slots = slot.flatten()
    for values, (name, i, j) in zip(basis, ENTRIES, strict=True):
        p0, q0 = _FIRST_ROW[name]
        pairs = sorted({(p0 + i, q0 + j), (p0 + j, q0 + i)})  # two, where i differs from j
        left, right = [p for p, _ in pairs], [q for _, q in pairs]
        element = weighted[:, :, left].flatten(1, 2).mT @ strains.at[:, :, right].flatten(1, 2)
        if name == "B":  # stands in C twice, above and below the diagonal
            element = element + element.mT
        values.index_add_(0, slots, element.flatten())
    return basis
