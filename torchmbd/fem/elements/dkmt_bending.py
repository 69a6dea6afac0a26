"""Curvatures and transverse shear strains of the discrete Kirchhoff-Mindlin triangle (DKMT).

Freedoms of a corner: w, beta_x, beta_y (u = z beta_x, v = z beta_y; from rotations: beta_x = phi_y, beta_y = -phi_x).
The rotation gets a quadratic part along each side k = ij (tangent t_k, length L_k),

    beta = sum_i lambda_i beta_i + sum_k 4 lambda_i lambda_j Delta_k t_k

and the gap g_k of a side, its mean shear strain with linear rotations, is shared between bending (Delta_k) and shear (gamma_k)
by phi_k = shear_length^2 / size_k^2 (sides.py).

shear_length^2   12 D / As [m2] with the mean bending stiffness D and the mean shear stiffness As of the laminate
size_k^2         L_k^2, or 4 times the mean area of the triangles at this side if that is less [m2]. In slender cells the
                 shear of a twisted strip changes over their width, not over the length of their sides

Thin plates (phi -> 0) get the discrete Kirchhoff triangle DKT, thick ones (phi -> infinity) linear rotations with the
shear of the sides; no locking between. Inside, gamma is linear. Its mean c and its curl omega are those of the field
with the constant tangential parts gamma_k on the sides (as in MITC3), and of all such fields it has the least energy:

    gamma(x) = c + omega J R x / tr J        R: turn by 90 degrees,  J: mean of x x' over the triangle

(for equilateral triangles it is MITC3's own). Because phi depends on mesh and shear_length only, never on the ply angles,
the stiffness stays linear in D and As. The condition is local: an approximate shear_length changes the error of a given
mesh, not the limit (energy at the side is stationary in the share).
A constant shear with all rotations held is met in the thick limit only: with linear moments the nodes of a thin plate show
the same pattern of gaps at a cost D / L^2 instead of As, and a triangle alone cannot tell them apart. Elements that take
every gap for shear (MITC3) meet it and pay in bending: 0.58 instead of 0.91 of the pinched cylinder with 8 x 8 cells.
Source: I. Katili, A new discrete Kirchhoff-Mindlin element based on Mindlin-Reissner plate theory and assumed shear
strain fields, Part I, Int. J. Numer. Methods Eng. 36 (1993) 1859-1883, doi:10.1002/nme.1620361106.
Checked in tests/fem/elements/test_dkmt_bending.py, tests/validation/test_twisted_strip.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmbd.fem.elements.sides import gaps, quad_size2, split_gaps

_SIDES = ((0, 1), (1, 2), (2, 0))


def plate_strains(
    corners: Float[Tensor, "m 3 2"],
    area: Float[Tensor, " m"],
    shear_length: float | Float[Tensor, " m"],
    side_area: Float[Tensor, "m 3"] | None = None,
    mixed: Bool[Tensor, "m 3"] | None = None,
) -> tuple[Float[Tensor, "m 3 3 9"], Float[Tensor, "m 3 2 9"]]:
    """Return curvatures and shear strains at the middles of the sides 12, 23, 31.

    side_area      mean area of the cells at each side [m2]; None: triangles that stand alone
    mixed          sides with a cell of another kind, whose size is that of quadrilaterals (sides.py); None: there are none
    curvatures     [triangle, point, (kappa_xx, kappa_yy, kappa_xy), (w, beta_x, beta_y) x 3 corners]
    shear strains  [triangle, point, (gamma_xz, gamma_yz), the same freedoms]
    """
    slopes = _barycentric_gradients(corners, area)
    gap, tangent, length = gaps(corners)
    at_side = area[:, None].expand(-1, 3) if side_area is None else side_area
    size2 = torch.minimum(length**2, 4.0 * at_side)
    if mixed is not None:
        size2 = torch.where(mixed, quad_size2(length, at_side), size2)
    delta, side_shear = split_gaps(gap, shear_length, size2)
    return _curvatures(slopes, tangent, delta), _shear_strains(corners, area, length[..., None] * side_shear)


def _barycentric_gradients(corners: Tensor, area: Tensor) -> Float[Tensor, "m 3 2"]:
    """Gradients of the barycentric coordinates lambda_1, lambda_2, lambda_3."""
    opposite = corners.roll(-2, dims=1) - corners.roll(-1, dims=1)
    return torch.stack([-opposite[..., 1], opposite[..., 0]], dim=-1) / (2.0 * area[:, None, None])


def _curvatures(slopes: Tensor, tangent: Tensor, delta: Tensor) -> Float[Tensor, "m 3 3 9"]:
    linear = slopes.new_zeros(len(slopes), 3, 9)
    for i in range(3):
        linear[:, 0, 3 * i + 1] = linear[:, 2, 3 * i + 2] = slopes[:, i, 0]
        linear[:, 1, 3 * i + 2] = linear[:, 2, 3 * i + 1] = slopes[:, i, 1]
    points = []
    for a, b in _SIDES:
        kappa = linear
        for k, (i, j) in enumerate(_SIDES):
            # Gradient of 4 lambda_i lambda_j at the middle of side ab, where lambda_a = lambda_b = 1/2.
            grad = 2.0 * ((j in (a, b)) * slopes[:, i] + (i in (a, b)) * slopes[:, j])
            t = tangent[:, k]
            unit = torch.stack(
                [grad[:, 0] * t[:, 0], grad[:, 1] * t[:, 1], grad[:, 0] * t[:, 1] + grad[:, 1] * t[:, 0]], dim=-1
            )
            kappa = kappa + unit[:, :, None] * delta[:, k, None, :]
        points.append(kappa)
    return torch.stack(points, dim=1)


def _shear_strains(corners: Tensor, area: Tensor, along: Tensor) -> Float[Tensor, "m 3 2 9"]:
    """Shear strains at the middles of the sides, from gamma_k L_k of the sides [triangle, side, freedom]."""
    x = corners - corners.mean(1, keepdim=True)
    quarter = x.new_tensor([[0.0, -1.0], [1.0, 0.0]])
    opposite = x.roll(-2, dims=1) @ quarter.T  # of side k, turned: Whitney's field of it has this mean, over 2 area
    mean = torch.einsum("mkc,mkf->mcf", opposite, along) / (-2.0 * area[:, None, None])
    curl = along.sum(1) / area[:, None]
    J = x.mT @ x
    middles = 0.5 * (x + x.roll(-1, dims=1)) @ (J @ quarter).mT / J.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    return mean[:, None] + middles[..., None] * curl[:, None, None]
