"""Definition of a shell element: eight plate strains at some points of a cell, from six degrees of freedom at each corner.

    (eps_xx, eps_yy, gamma_xy, kappa_xx, kappa_yy, kappa_xy, gamma_xz, gamma_yz) = E (u1 u2 u3 phi1 phi2 phi3) x corners

strains in the laminate's axes (facet.py), degrees of freedom in mesh axes. E depends on the cell and on the laminate's
isotropic mean, on no ply angle: so the stiffness sum_points weight E' C E is linear in the laminate's 21 entries (plate.py).
Only membrane forces that vary over the cell depend on the laminate otherwise, in elements that have them (inner_forces.py).
An element is a function (Facets, IsotropicMean) -> Strains in a file of its own, and one line in cell_stiffness.py. It keeps
rigid motions free, the rank full, constant strains exact on meshes that mix kinds (sides.py), and does not depend on which
corner is the first: tests/contracts/test_shell_elements.py checks all elements.
Cells lie flat in space: the local degrees of freedom are the global ones turned by `axes`.

Shear forces follow from equilibrium, for the stresses of plies and between them:

    Q_x = M_xx,x + M_xy,y     Q_y = M_xy,x + M_yy,y     M,x = (D - B A^-1 B) kappa,x

An element leaves a part of the gaps at its sides to shear by the mean stiffness of the laminate over all directions (sides.py).
That makes K good, but As gamma is not a measure of Q unless cells are as short as the plate is thick: in thin carbon plates
it is up to half too small. In a strip with gap g and the shares 1 / (1 + phi) of bending and phi / (1 + phi) of shear, the
element's energy is

    1/2 (12 D / L^2 / (1 + phi)^2 + As (phi / (1 + phi))^2) g^2,     whose derivative with respect to g is Q

that is equilibrium of the element's moments times the share of bending and As gamma times that of shear. Cells take both so:

    Q = P (kappa,x kappa,y) / (1 + phi) + As gamma phi / (1 + phi)     P: the sum of equilibrium above

Exact for linear moments of strips, in thick cells and in thin ones. Membrane forces are taken as constant over the cell, as in
the spread of Q through the thickness (transverse_shear.py); the rotary inertia of the plate is left out.
Differentiable, forward and reverse, in the laminate and the displacements, with lanes.
Checked in tests/fem/elements/test_shear_recovery.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements.inner_forces import InnerForces
from torchmbd.fem.materials import LaminateStiffness

#: Freedoms of a corner, in this order, in every vector of torchmbd: displacements [m], rotations [rad].
FREEDOMS = ("u1", "u2", "u3", "phi1", "phi2", "phi3")
_PARTS = torch.tensor([[0, 2], [2, 1]])  # moments (xx, yy, xy) whose derivatives by x and y are Q_x, Q_y


class ShearRecovery(NamedTuple):
    """Rows for the shear forces of a cell: derivatives of curvatures by x and y, and shear strains.

    slopes   times the share of bending
    strain   times the share of shear
    """

    slopes: Float[Tensor, "m 2 3 freedoms"]
    strain: Float[Tensor, "m 2 freedoms"]

    def strains(
        self, law: LaminateStiffness, displacements: Float[Tensor, "*lanes m f k"]
    ) -> Float[Tensor, "*lanes m 2 k"]:
        """Return As^-1 Q of every cell; law: of one laminate [*lanes, 1, ...] or of each cell [*lanes, m, ...]."""
        D = law.D - law.B @ torch.linalg.inv(law.A) @ law.B  # not solve: its tangents under vmap are wrong (torch 2.13)
        P = D[..., _PARTS, :].flatten(-2)
        bending = torch.linalg.inv(law.As) @ P @ (self.slopes.flatten(-3, -2) @ displacements)
        return bending + self.strain @ displacements


class Strains(NamedTuple):
    """Strains of every cell, as rows on its degrees of freedom.

    at      at the points
    weight  area of each point [m2]
    center  for the stresses of plies
    forces  membrane forces that vary over the cell
    shear   rows for the shear forces; None: these follow from `center`
    """

    at: Float[Tensor, "m points 8 freedoms"]
    weight: Float[Tensor, "m points"]
    center: Float[Tensor, "m 8 freedoms"]
    forces: InnerForces | None = None
    shear: ShearRecovery | None = None


def in_mesh_axes(
    axes: Float[Tensor, "m 3 3"],
    membrane: Float[Tensor, "m p 3 c f"],
    curvature: Float[Tensor, "m p 3 3c"],
    shear: Float[Tensor, "m p 2 3c"],
) -> Float[Tensor, "m p 8 6c"]:
    """Join the strains in the plane of each cell, and express them by degrees of freedom in mesh axes.

    membrane    of (u, v, theta_z), or of all six in the cell's axes, of every corner
    curvature, shear   of (w, beta_x, beta_y); beta_x = phi_y, beta_y = -phi_x
    """
    if membrane.shape[-1] == 3:
        pad = torch.nn.functional.pad
        membrane = pad(membrane[..., :2], (0, 4)) + pad(membrane[..., 2:], (5, 0))
    return to_mesh_axes(axes, torch.cat([membrane, plate_rows(torch.cat([curvature, shear], dim=2))], dim=2))


def plate_rows(rows: Float[Tensor, "*rows 3c"]) -> Float[Tensor, "*rows c 6"]:
    """Return rows on (w, beta_x, beta_y) of the corners as rows on all their degrees of freedom, in the cell's axes."""
    w, x, y = rows.unflatten(-1, (-1, 3)).unbind(-1)
    zero = torch.zeros_like(w)
    return torch.stack([zero, zero, w, -y, x, zero], dim=-1)


def to_mesh_axes(axes: Float[Tensor, "m 3 3"], local: Float[Tensor, "m *rows c 6"]) -> Float[Tensor, "m *rows 6c"]:
    """Return rows on degrees of freedom of the corners in the cell's axes as rows on those in mesh axes."""
    vectors = local.unflatten(-1, (2, 3))  # a displacement and a rotation at every corner
    return torch.einsum("m...cvi,mij->m...cvj", vectors, axes).flatten(-3)
