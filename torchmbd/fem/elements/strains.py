"""What a shell element is: all eight plate strains at some points of a cell, from the six freedoms of its corners.

    (eps_xx, eps_yy, gamma_xy, kappa_xx, kappa_yy, kappa_xy, gamma_xz, gamma_yz) = E (u1 u2 u3 phi1 phi2 phi3) x corners

in the laminate's axes (facet.py) and, of the freedoms, in mesh axes. E knows the cell and the laminate's isotropic mean, no
ply angle: so the stiffness sum_points weight E' C E is linear in the laminate's 21 entries (plate.py). What has to follow
the laminate are membrane forces that vary over the cell, in elements that have them (inner_forces.py).
An element is a function (Facets, IsotropicMean) -> Strains in a file of its own, and one line in shell_elements.py. It keeps
rigid motions free, the rank full, constant strains exact on meshes that mix kinds (sides.py), and no place of its numbering
better than another: tests/contracts/test_shell_elements.py runs over all.
Cells lie flat in space: the local freedoms are the global ones turned by `axes`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements.inner_forces import InnerForces

#: Freedoms of a corner, in this order, in every vector of torchmbd: displacements [m], rotations [rad].
FREEDOMS = ("u1", "u2", "u3", "phi1", "phi2", "phi3")


class ShearRecovery(NamedTuple):
    """What shear forces of a cell are recovered from (shear_recovery.py): derivatives of curvatures by x and y, shear strains.

    slopes   times the share of bending
    strain   times the share of shear
    """

    slopes: Float[Tensor, "m 2 3 freedoms"]
    strain: Float[Tensor, "m 2 freedoms"]


class Strains(NamedTuple):
    """Strains at the points of every cell, the area that each point stands for [m2], the strains to judge plies by, forces.

    shear   what shear forces are recovered from; None: from the strains of `center`
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
    """Join the strains of a cell's plane and take freedoms in mesh axes.

    membrane    of (u, v, theta_z), or of all six in the cell's axes, of every corner
    curvature, shear   of (w, beta_x, beta_y); beta_x = phi_y, beta_y = -phi_x
    """
    m, points, _, corners, given = membrane.shape
    local = membrane.new_zeros(m, points, 8, corners, 6)
    local[:, :, :3, :, [0, 1, 5] if given == 3 else list(range(6))] = membrane
    local[:, :, 3:] = of_plate(torch.cat([curvature, shear], dim=2))
    return turned(axes, local)


def of_plate(rows: Float[Tensor, "*rows 3c"]) -> Float[Tensor, "*rows c 6"]:
    """Rows on (w, beta_x, beta_y) of the corners as rows on all their freedoms in the cell's axes."""
    w, x, y = rows.unflatten(-1, (-1, 3)).unbind(-1)
    zero = torch.zeros_like(w)
    return torch.stack([zero, zero, w, -y, x, zero], dim=-1)


def turned(axes: Float[Tensor, "m 3 3"], local: Float[Tensor, "m *rows c 6"]) -> Float[Tensor, "m *rows 6c"]:
    """Take rows on the freedoms of a cell's corners from its axes to mesh axes."""
    vectors = local.unflatten(-1, (2, 3))  # a displacement and a rotation at every corner
    return torch.einsum("m...cvi,mij->m...cvj", vectors, axes).flatten(-3)
