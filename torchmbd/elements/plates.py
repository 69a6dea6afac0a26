"""Parts of an assembly: laminated plates on some cells of a mesh, and point masses.

mass of a plate     "lumped": a third of each triangle at its corners, eqs. (2) and (13);
                    "consistent": at the middles of its sides, that is with linear shape functions, for comparison
                    (quadrilaterals: the mean of both ways to cut them)

    m = rho_0 area     at the height z_s = rho_1 / rho_0 along the normal n     mu = (rho_2 - rho_0 z_s^2 n.n) area

rho_0, rho_1, rho_2   moments of the laminate's density through its thickness [kg/m2, kg/m, kg]
n                     mean of the normals of the cells around the point, weighted with their areas (flat plate: n.n = 1)

So translations are coupled with rotations by rho_1, and rotations have the inertia rho_2 about the middle surface.
Checked in tests/elements/test_assembly.py, tests/bodies/test_mass_off_middle.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.elements.assembly import MassPoints
from torchmbd.elements.plate import PlateMatrices
from torchmbd.errors import unknown
from torchmbd.materials import Laminate
from torchmbd.mesh import Mesh
from torchmbd.numerics.gradients import constants
from torchmbd.numerics.sparse import Pattern

MASSES = ("lumped", "consistent")


class Plates:
    """One laminate on cells of a mesh (default: all).

    direction   the laminate's x-axis in mesh axes: [3], or one for each cell of the mesh [m, 3]
    cells       numbers of the cells that are made of it
    mass        "lumped" or "consistent"
    """

    def __init__(
        self,
        mesh: Mesh,
        laminate: Laminate,
        direction: Sequence[float] | Tensor = (1.0, 0.0, 0.0),
        cells: Sequence[int] | Tensor | None = None,
        mass: str = "lumped",
    ) -> None:
        if mass not in MASSES:
            raise unknown("mass", mass, MASSES)
        self.laminate = laminate
        self.matrices = PlateMatrices(mesh, laminate, direction, cells)
        self.pattern = self.matrices.pattern
        self._ends, self._area, self._normal = _points(self.matrices, mass == "consistent")

    def values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, "*lanes nnz"]:
        """K of the present design, or only some entries of it."""
        return self.matrices.values(self.laminate.entries(), entries)

    def modules(self) -> dict[str, nn.Module]:
        """The laminate."""
        return {"laminate": self.laminate}

    def masses(self) -> MassPoints:
        """Mass points of the present design."""
        mass, rotary = (
            x[..., None] * self._area for x in (self.laminate.mass_per_area, self.laminate.rotary_inertia_per_area)
        )
        if self.laminate.centered:
            return MassPoints(self._ends, mass, rotary)
        height = self.laminate.first_moment_per_area / self.laminate.mass_per_area
        arm = height[..., None, None] * self._normal
        return MassPoints(self._ends, mass, rotary - mass * (arm * arm).sum(-1), arm)


class PointMasses:
    """Masses [kg] with isotropic rotary inertias [kg m2] at nodes; no stiffness."""

    @constants
    def __init__(self, mesh: Mesh, nodes: Sequence[int], mass: Sequence[float], rotary: Sequence[float]) -> None:
        none = torch.empty(0, dtype=torch.long)
        self.pattern = Pattern(none, none, 6 * len(mesh.nodes))
        self._nodes = torch.tensor(list(nodes), dtype=torch.long)
        self._mass, self._rotary = (torch.tensor(list(x), dtype=torch.float64) for x in (mass, rotary))

    def values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, " 0"]:
        """No stiffness."""
        return torch.zeros(0, dtype=torch.float64)

    def modules(self) -> dict[str, nn.Module]:
        """Nothing to design."""
        return {}

    def masses(self) -> MassPoints:
        """The masses."""
        return MassPoints(self._nodes[:, None].expand(-1, 2), self._mass, self._rotary)


def _points(matrices: PlateMatrices, consistent: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Node pairs of the mass points, the area of each, and the mean normal there."""
    corners, area, normals = matrices.pieces
    other = corners.roll(-1, dims=1) if consistent else corners
    pairs, place = torch.unique(
        torch.stack([corners, other], dim=-1).flatten(0, 1).sort(dim=1).values, dim=0, return_inverse=True
    )
    thirds = (area / 3.0).repeat_interleave(3)
    whole = thirds.new_zeros(len(pairs)).index_add(0, place, thirds)
    normal = torch.zeros(len(pairs), 3, dtype=area.dtype)
    normal.index_add_(0, place, thirds[:, None] * normals.repeat_interleave(3, dim=0))
    return pairs, whole, normal / whole[:, None]
