"""The four plane stress states that run linearly over a cell, in equilibrium: their forces, displacements and work on sides.

    sigma_b (xx, yy, xy):   (y, 0, 0),  (0, x, 0),  (x, 0, -y),  (0, y, -x)

They belong to any material: strains S sigma_b are linear, hence compatible, with displacements that are quadratic,

    u = a1 x^2 / 2 + a2 x y + p y^2 / 2,   v = b1 x y + b2 y^2 / 2 + q x^2 / 2,   theta = ((b1 - p) y + (q - a2) x) / 2

of eps = (a1 x + a2 y, b1 x + b2 y, c1 x + c2 y), p = c2 - b1, q = c1 - a2. On the sides of a cell, which stretch linearly and
bend as parabolas, the tractions t_b work

    W_b u = sum_k int t_b . u_k ds,     u_k = (1 - s) u_i + s u_j + L_k / 2 s (1 - s) (theta_j - theta_i) n_k

Bending of the fibers along a median: stress e o e times the distance across. Two of the four states are that.
Coordinates from the centroid, in units of the square root of the area.
Source: M. A. Aminpour, Int. J. Numer. Methods Eng. 33 (1992) 19-38; T. H. H. Pian and K. Sumihara, Int. J. Numer. Methods Eng.
20 (1984) 1685-1695 (bending along medians).
Checked in tests/fem/elements/test_quad_states.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def stresses(z: Float[Tensor, "m p 2"]) -> Float[Tensor, "m p 3 4"]:
    """The states at given places."""
    x, y = z.unbind(-1)
    zero = torch.zeros_like(x)
    states = ((y, zero, zero), (zero, x, zero), (x, zero, -y), (zero, y, -x))
    return torch.stack([torch.stack(state, dim=-1) for state in states], dim=-1)


def displacements(x: Float[Tensor, "m 4 2"], S: Float[Tensor, "*laws 3 3"]) -> Float[Tensor, "*laws m 12 4"]:
    """(u, v, theta) x 4 corners of the states, of materials with compliance S."""
    eye = torch.eye(2, dtype=x.dtype)
    slopes = S[..., None, :, :] @ stresses(eye[None])[0]  # d eps / dx, d eps / dy of the states [*laws, 2, 3, 4]
    (a1, b1, c1), (a2, b2, c2) = (of.unbind(-2) for of in slopes[..., None, None, :, :, :].unbind(-3))
    p, q = c2 - b1, c1 - a2
    X, Y = (coordinate[..., None] for coordinate in x.unbind(-1))
    u = 0.5 * a1 * X**2 + a2 * X * Y + 0.5 * p * Y**2
    v = 0.5 * b2 * Y**2 + b1 * X * Y + 0.5 * q * X**2
    theta = 0.5 * ((b1 - p) * Y + (q - a2) * X)
    return torch.stack([u, v, theta], dim=-2).flatten(-3, -2)


def side_work(x: Float[Tensor, "m 4 2"]) -> Float[Tensor, "m 4 12"]:
    """W: work of the states on the sides, from (u, v, theta) of the corners."""
    side = x.roll(-1, dims=1) - x
    nx, ny = side[..., 1], -side[..., 0]  # times the length
    sxx, syy, sxy = stresses(x).unbind(2)  # at the corners [m, 4, states]
    work = x.new_zeros(len(x), 4, 4, 3)
    for i in range(4):
        j = (i + 1) % 4
        n = nx[:, i, None], ny[:, i, None]
        start, end = (
            torch.stack([sxx[:, c] * n[0] + sxy[:, c] * n[1], sxy[:, c] * n[0] + syy[:, c] * n[1]], -1) for c in (i, j)
        )
        work[:, :, i, :2] += (2.0 * start + end) / 6.0
        work[:, :, j, :2] += (start + 2.0 * end) / 6.0
        bulge = ((start + end) * torch.stack(n, -1)).sum(-1) / 24.0
        work[:, :, i, 2] -= bulge
        work[:, :, j, 2] += bulge
    return work.flatten(-2)


def bending(medians: Float[Tensor, "m 2 2"]) -> Float[Tensor, "m 4 2"]:
    """R: bending of fibers along each median, as a sum of the states."""
    slopes = stresses(torch.eye(2, dtype=medians.dtype)[None])[0].flatten(0, 1)  # [6, states]
    ex, ey = medians.unbind(-1)
    stress, across = torch.stack([ex * ex, ey * ey, ex * ey], -1), torch.stack([-ey, ex], -1)
    bent = (across[..., None] * stress[..., None, :]).flatten(-2).mT  # [m, 6, median]
    return torch.linalg.pinv(slopes) @ bent
