"""Curvatures and transverse shear strains of the discrete Kirchhoff-Mindlin triangle (DKMT).

Freedoms of a corner: w, beta_x, beta_y (u = z beta_x, v = z beta_y; from rotations: beta_x = phi_y, beta_y = -phi_x).
The rotation gets a quadratic part along each side k = ij (tangent t_k, length L_k),

    beta = sum_i lambda_i beta_i + sum_k 4 lambda_i lambda_j Delta_k t_k

and the side's mean shear strain, with the rotations linear, is the gap
    g_k = (w_j - w_i) / L_k + t_k . (beta_i + beta_j) / 2 .
The gap is shared between bending and shear as in a strip of plate under linear moment,

    Delta_k = -3/2 g_k / (1 + phi_k),     gamma_k = g_k phi_k / (1 + phi_k),     phi_k = (shear_length / L_k)^2

shear_length^2   12 D / As [m2] with the mean bending stiffness D and the mean shear stiffness As of the laminate

Thin plates (phi -> 0) get the discrete Kirchhoff triangle DKT, thick ones (phi -> infinity) linear rotations with the
shear of the sides; no locking between. Inside, gamma is the linear field with the constant tangential parts gamma_k
on the sides (as in MITC3). Because phi depends on mesh and shear_length only, never on the ply angles, the stiffness
stays linear in D and As. The condition is local: an approximate shear_length changes the error of a given mesh, not
the limit (energy at the side is stationary in the share).
A constant shear with all rotations held is met in the limits only: no 9-freedom triangle meets it and does not lock,
because thin plates need the same pattern of gaps at a cost D / L^2 instead of As.
Source: I. Katili, A new discrete Kirchhoff-Mindlin element based on Mindlin-Reissner plate theory and assumed shear
strain fields, Part I, Int. J. Numer. Methods Eng. 36 (1993) 1859-1883, doi:10.1002/nme.1620361106.
Checked in tests/elements/test_dkmt_bending.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_SIDES = ((0, 1), (1, 2), (2, 0))


def plate_strains(
    corners: Float[Tensor, "m 3 2"], area: Float[Tensor, " m"], shear_length: float
) -> tuple[Float[Tensor, "m 3 3 9"], Float[Tensor, "m 3 2 9"]]:
    """Return curvatures and shear strains at the middles of the sides 12, 23, 31.

    curvatures     [triangle, point, (kappa_xx, kappa_yy, kappa_xy), (w, beta_x, beta_y) x 3 corners]
    shear strains  [triangle, point, (gamma_xz, gamma_yz), the same freedoms]
    """
    slopes = _barycentric_gradients(corners, area)
    gap, tangent, length = _gaps(corners)
    phi = (shear_length / length) ** 2
    delta = (-1.5 / (1.0 + phi))[..., None] * gap
    side_shear = (phi / (1.0 + phi))[..., None] * gap
    return _curvatures(slopes, tangent, delta), _shear_strains(slopes, length, side_shear)


def _barycentric_gradients(corners: Tensor, area: Tensor) -> Float[Tensor, "m 3 2"]:
    """Gradients of the barycentric coordinates lambda_1, lambda_2, lambda_3."""
    opposite = corners.roll(-2, dims=1) - corners.roll(-1, dims=1)
    return torch.stack([-opposite[..., 1], opposite[..., 0]], dim=-1) / (2.0 * area[:, None, None])


def _gaps(corners: Tensor) -> tuple[Float[Tensor, "m 3 9"], Float[Tensor, "m 3 2"], Float[Tensor, "m 3"]]:
    """Mean shear strain of each side with linear rotations; tangents and lengths of the sides 12, 23, 31."""
    side = corners.roll(-1, dims=1) - corners
    length = side.norm(dim=-1)
    tangent = side / length[..., None]
    gap = corners.new_zeros(len(corners), 3, 9)
    for k, (i, j) in enumerate(_SIDES):
        gap[:, k, 3 * i], gap[:, k, 3 * j] = -1.0 / length[:, k], 1.0 / length[:, k]
        gap[:, k, 3 * i + 1 : 3 * i + 3] = gap[:, k, 3 * j + 1 : 3 * j + 3] = 0.5 * tangent[:, k]
    return gap, tangent, length


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


def _shear_strains(slopes: Tensor, length: Tensor, side_shear: Tensor) -> Float[Tensor, "m 3 2 9"]:
    points = []
    for a, b in _SIDES:
        gamma = 0.0
        for k, (i, j) in enumerate(_SIDES):
            # Whitney's field of side ij: tangential part 1 / L_k on this side, none on the others.
            whitney = 0.5 * ((i in (a, b)) * slopes[:, j] - (j in (a, b)) * slopes[:, i])
            gamma = gamma + (length[:, k, None] * whitney)[:, :, None] * side_shear[:, k, None, :]
        points.append(gamma)
    return torch.stack(points, dim=1)
