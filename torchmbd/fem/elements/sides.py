"""Rules that cells of all kinds follow at their sides, so that neighbors fit: lumping of membrane stress, gaps of shear.

Sides k = ij run 12, 23, ... around the cell; tangent t_k, outward normal n_k, length L_k.

lumping   a constant membrane stress acts on the corners of a side as half its traction each, and as moments of the normal
          traction alpha L_k^2 / 12 (-, +): the mean strain is what these forces do work on,

              mean eps = 1 / area sum_k sym n_k o (L_k (u_i + u_j) / 2 + alpha L_k^2 / 12 (theta_j - theta_i) n_k)

          alpha = 1: the sides bend as beams; alpha is free, but the two cells of a side must have the same
gap       mean shear strain of a side with linear rotations,  g_k = (w_j - w_i) / L_k + t_k . (beta_i + beta_j) / 2,
          shared between bending and shear as in a strip of plate under linear moment:

              Delta_k = -3/2 g_k / (1 + phi_k),     gamma_k = g_k phi_k / (1 + phi_k),     phi_k = shear_length^2 / size_k^2

          Delta_k: the quadratic part of the rotation along the side (triangle.py)
size_k    1 / size^2 = 1 / L_k^2 + (L_k / cell)^2 of quadrilaterals: a gap is closed by bending along the side, or by twist
          across the cell (cell: mean area at this side [m2])   [m]
Source: C. A. Felippa (2003), I. Katili (1993), see triangle.py.
Checked in tests/fem/elements/test_triangle.py, tests/fem/elements/test_plate_patch.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def mean_strain(
    corners: Float[Tensor, "m c 2"], area: Float[Tensor, " m"], alpha: Float[Tensor, "m c"]
) -> Float[Tensor, "m 3 f"]:
    """Mean (eps_xx, eps_yy, gamma_xy) from (u, v, theta_z) of the corners; alpha of every side."""
    side = corners.roll(-1, dims=1) - corners
    nx, ny = side[..., 1], -side[..., 0]  # times the length
    zero = torch.zeros_like(nx)
    push = torch.stack([torch.stack([nx, zero, ny], -1), torch.stack([zero, ny, nx], -1)], -1)  # [m, k, 3, (u, v)]
    bulge = alpha[..., None] / 12.0 * torch.stack([nx * nx, ny * ny, 2.0 * nx * ny], -1)
    of_corner = [0.5 * (push + push.roll(1, dims=1)), (bulge.roll(1, dims=1) - bulge)[..., None]]
    return torch.cat(of_corner, -1).transpose(1, 2).flatten(-2) / area[:, None, None]


def dyad(p: Float[Tensor, "*n 2"], q: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
    """The symmetric product p o q of vectors as a strain: p_x q_x, p_y q_y, p_x q_y + p_y q_x."""
    (px, py), (qx, qy) = p.unbind(-1), q.unbind(-1)
    return torch.stack([px * qx, py * qy, px * qy + py * qx], dim=-1)


def gaps(
    corners: Float[Tensor, "m c 2"],
) -> tuple[Float[Tensor, "m c f"], Float[Tensor, "m c 2"], Float[Tensor, "m c"]]:
    """Gap of each side from (w, beta_x, beta_y) of the corners; tangents and lengths of the sides."""
    m, count, _ = corners.shape
    side = corners.roll(-1, dims=1) - corners
    length = side.norm(dim=-1)
    tangent = side / length[..., None]
    gap = corners.new_zeros(m, count, 3 * count)
    for k in range(count):
        i, j = k, (k + 1) % count
        gap[:, k, 3 * i], gap[:, k, 3 * j] = -1.0 / length[:, k], 1.0 / length[:, k]
        gap[:, k, 3 * i + 1 : 3 * i + 3] = gap[:, k, 3 * j + 1 : 3 * j + 3] = 0.5 * tangent[:, k]
    return gap, tangent, length


def split_gaps(
    gap: Tensor, shear_length: float | Float[Tensor, " m"], size2: Float[Tensor, "m c"]
) -> tuple[Tensor, Tensor]:
    """Split gaps into bending and shear: Delta_k and gamma_k of every side, as rows on the degrees of freedom of the gap."""
    phi = torch.as_tensor(shear_length, dtype=size2.dtype)[..., None] ** 2 / size2
    return (-1.5 / (1.0 + phi))[..., None] * gap, (phi / (1.0 + phi))[..., None] * gap


def quad_size2(length: Float[Tensor, "m c"], side_area: Float[Tensor, "m c"]) -> Float[Tensor, "m c"]:
    """size_k^2 at the sides of quadrilaterals [m2]."""
    return 1.0 / (1.0 / length**2 + (length / side_area) ** 2)
