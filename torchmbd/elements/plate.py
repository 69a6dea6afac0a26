"""Stiffness of a laminated plate or faceted shell, linear in the laminate's 21 entries.

    K(b) = sum_i s_i(b) K_i,      s = laminate.entries() [..., 21],      K_i = sum_e sum_points area/3 E' C_i E

C_i     the pattern of entry i in the 8 x 8 law (N, M, Q) = C (eps, kappa, gamma)
E       strains of the triangle, torchmbd.elements.strains (OPT membrane + DKMT bending and shear)
basis   values of all K_i on one sparsity pattern, made once per mesh            [21, nnz]

So a new design costs one product `entries @ basis`, whatever the mesh, and derivatives in the design are exact.
Two numbers enter E from the laminate: mean Poisson's ratio and shear length (IsotropicMean). They are constants under
any change of ply angle. When *thickness* is a design variable they stay those of the laminate given here: still a
converging element with the exact gradient of what it computes, tuned to a neighboring thickness. A fifth more or less
moves frequencies of a mesh by 0.2 % beside the element tuned anew, half or twice the thickness by 0.5 and 2 %; make the
body anew after larger changes.
Global freedom index = 6 * node + freedom (u1 u2 u3 phi1 phi2 phi3), in mesh axes, SI units.
Source: eqs. (10)-(13) of the paper; Felippa (2003) and Katili (1993), see opt_membrane.py and dkmt_bending.py.
Checked in tests/elements/test_plate_*.py, tests/elements/test_thickness.py, tests/convergence/test_plate*.py,
tests/validation/test_*plate*.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.elements.facet import facets
from torchmbd.elements.strains import strain_matrices
from torchmbd.errors import InputError
from torchmbd.materials import ENTRIES, IsotropicMean, Laminate
from torchmbd.mesh import Mesh
from torchmbd.numerics.sparse import Pattern, SparseMatrix

_FIRST_ROW = {"A": (0, 0), "B": (0, 3), "D": (3, 3), "As": (6, 6)}


class PlateMatrices:
    """What a mesh contributes to stiffness and mass, made once per mesh.

    pattern   where K is not zero
    basis     [21, nnz]: K values = entries @ basis, `...` lanes of entries give [..., nnz]
    area      [n] tributary area of each node [m2]: lumped mass = mass_per_area * area,
              nodal rotary inertia = rotary_inertia_per_area * area

    laminate    the laminate, of which only the mean properties enter here; or these
    direction   the laminate's x-axis in mesh axes, projected into each triangle: [3], or one for each triangle [m, 3]
    triangles   indices of the triangles that are made of it; None: all of the mesh. `members` keeps them
    """

    def __init__(
        self,
        mesh: Mesh,
        laminate: Laminate | IsotropicMean,
        direction: Sequence[float] | Tensor = (1.0, 0.0, 0.0),
        triangles: Sequence[int] | Tensor | None = None,
    ) -> None:
        self.mesh = mesh
        self.members = torch.arange(len(mesh.triangles)) if triangles is None else torch.as_tensor(triangles)
        self.triangles = mesh.triangles[self.members]
        self.mean = laminate if isinstance(laminate, IsotropicMean) else IsotropicMean.of(laminate)
        self.facets = facets(mesh, direction, self.members)
        self.area = _tributary(self.triangles, self.facets.area, len(mesh.nodes))
        self.pattern, slot = _block_pattern(self.triangles, len(mesh.nodes))
        self.basis = _basis(strain_matrices(self.facets, self.mean), self.facets.area, slot, self.pattern.nnz)

    def stiffness(self, entries: Float[Tensor, "*lanes 21"]) -> SparseMatrix:
        """Return K of one laminate or of a batch."""
        if entries.shape[-1] != len(ENTRIES):
            raise InputError(f"entries has shape {tuple(entries.shape)}; allowed: [..., {len(ENTRIES)}]")
        return SparseMatrix(self.pattern, entries @ self.basis)

    @cached_property
    def center_strains(self) -> Float[Tensor, "m 8 18"]:
        """Plate strains at the centroid of each triangle, in laminate axes: the mean of the three points."""
        return strain_matrices(self.facets, self.mean).mean(1)

    def section_strains(self, displacements: Float[Tensor, "*lanes n 6 k"]) -> Float[Tensor, "*lanes m 8 k"]:
        """Return eps, kappa, gamma at the centroid of each triangle for k fields of nodal displacements, such as modes."""
        corners = displacements[..., self.triangles, :, :].flatten(-3, -2)
        return torch.einsum("msf,...mfk->...msk", self.center_strains, corners)

    def lumped_mass(
        self, mass_per_area: Float[Tensor, "*lanes"], rotary_inertia_per_area: Float[Tensor, "*lanes"]
    ) -> Float[Tensor, "*lanes freedoms"]:
        """Diagonal of the mass matrix: m, m, m, mu, mu, mu of each node [kg, kg m2], eqs. (2) and (13)."""
        per_area = torch.stack([mass_per_area] * 3 + [rotary_inertia_per_area] * 3, dim=-1)
        return (self.area[:, None] * per_area[..., None, :]).flatten(-2)


def _tributary(triangles: Tensor, area: Tensor, n: int) -> Tensor:
    thirds = (area / 3.0)[:, None].expand(-1, 3).reshape(-1)
    return area.new_zeros(n).index_add(0, triangles.flatten(), thirds)


def _block_pattern(triangles: Tensor, n: int) -> tuple[Pattern, Tensor]:
    """Pattern of 6 x 6 blocks between nodes that share a triangle, and the slots of every triangle's 18 x 18 numbers.

    The place of a number follows from the place of its block, so only the node pairs are sorted, not all coordinates.
    """
    a, b = triangles[:, :, None].expand(-1, 3, 3).reshape(-1), triangles[:, None, :].expand(-1, 3, 3).reshape(-1)
    pair, block = torch.unique(a * n + b, sorted=True, return_inverse=True)
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
    element = slots[block].reshape(len(triangles), 3, 3, 6, 6).transpose(2, 3).reshape(len(triangles), 18, 18)
    return Pattern(rows, cols, 6 * n), element


def _basis(strains: Tensor, area: Tensor, slot: Tensor, nnz: int) -> Float[Tensor, "21 nnz"]:
    weighted = strains * (area / 3.0)[:, None, None, None]
    basis = area.new_zeros(len(ENTRIES), nnz)
    slots = slot.flatten()
    for values, (name, i, j) in zip(basis, ENTRIES, strict=True):
        p0, q0 = _FIRST_ROW[name]
        pairs = sorted({(p0 + i, q0 + j), (p0 + j, q0 + i)})  # two, where i differs from j
        left, right = [p for p, _ in pairs], [q for _, q in pairs]
        element = weighted[:, :, left].flatten(1, 2).mT @ strains[:, :, right].flatten(1, 2)
        if name == "B":  # stands in C twice, above and below the diagonal
            element = element + element.mT
        values.index_add_(0, slots, element.flatten())
    return basis
