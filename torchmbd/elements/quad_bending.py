"""Curvatures and transverse shear strains of the discrete Kirchhoff-Mindlin quadrilateral (DKMQ).

Freedoms of a corner: w, beta_x, beta_y as in dkmt_bending.py. The rotation gets a quadratic part along each side k,

    beta = sum_i N_i beta_i + sum_k P_k Delta_k t_k,      P = (1 - xi^2)(1 -+ eta) / 2,  (1 - eta^2)(1 +- xi) / 2

and the gap of a side is shared between bending (Delta_k) and shear (gamma_k), see sides.py. Inside, the covariant shear
strains run linearly between opposite sides (MITC4). Thin cells get the discrete Kirchhoff quadrilateral, thick ones MITC4;
no locking between. Rotations fit at the sides, so constant moments pass any patch test.

Left so, thin plates are too flexible: a clamped square with 8 x 8 cells by 1.8 % under a central load, one of 5 : 1 by 6 %.
Two corrections of what the curvature has beyond its mean over the cell; the mean, and with it the patch test, stays:

twist       of w = x^2 y the corners see beta_x = -2 x y, but not how beta_y = -x^2 runs between them: half of the twist. In
            thin plates twist is twice d beta_xi / d eta, as d beta_eta / d xi is the same; so the twist of the bilinear
            rotations (component along both medians) counts 1 + 1 / (1 + phi)^3 times, phi the mean of the four sides: once
            where cells are small enough to show the layers at free edges in which shear takes the twist
quadratic   what the quadratic parts add counts 3/2 times in the energy

Then 0.4 % and 1.3 %.
Source: I. Katili, A new discrete Kirchhoff-Mindlin element based on Mindlin-Reissner plate theory and assumed shear
strain fields, Part II, Int. J. Numer. Methods Eng. 36 (1993) 1885-1908, doi:10.1002/nme.1620361107; K.-J. Bathe and
E. N. Dvorkin, Int. J. Numer. Methods Eng. 21 (1985) 367-383 (MITC4).
Checked in tests/elements/test_quad.py, tests/contracts/test_shell_elements.py, tests/validation/test_twisted_strip.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.elements.quad_shape import Bilinear, middle
from torchmbd.elements.sides import crossed_size2, gaps, shared

#: Weight of the quadratic parts in the bending energy.
HIGHER = 1.5


def plate_strains(
    corners: Float[Tensor, "m 4 2"], points: Bilinear, shear_length: float, cell: Float[Tensor, "m 4"]
) -> tuple[Float[Tensor, "m p 3 12"], Float[Tensor, "m p 2 12"]]:
    """Return curvatures and shear strains at points of a whole rule; cell: mean area of the cells at each side [m2]."""
    gap, tangent, length = gaps(corners)
    size2 = crossed_size2(length, cell)
    delta, side_shear = shared(gap, shear_length, size2)
    quadratic = quadratic_curvatures(points, tangent) @ delta[:, None]
    share = (points.weight / points.weight.sum(1, keepdim=True))[..., None, None]
    linear = linear_curvatures(points)
    mean = (share * (linear + quadratic)).sum(1, keepdim=True)
    higher = linear - (share * linear).sum(1, keepdim=True)
    phi = (shear_length**2 / size2).mean(1)[:, None, None, None]
    twisted = higher + _twist(middle(corners).jacobian[:, 0])[:, None] @ higher / (1.0 + phi) ** 3
    bowed = quadratic - (share * quadratic).sum(1, keepdim=True)
    curvature = mean + twisted + HIGHER**0.5 * bowed
    return curvature, shear_strains(points, 0.5 * length[..., None] * side_shear)


def _twist(medians: Float[Tensor, "m 2 2"]) -> Float[Tensor, "m 3 3"]:
    """The part of a curvature that is twist of two medians: kappa_ab = a . kappa . b, times the dual vectors of a and b."""
    (ax, ay), (bx, by) = (v.unbind(-1) for v in medians.unbind(1))
    (px, py), (qx, qy) = (v.unbind(-1) for v in torch.linalg.inv(medians).unbind(-1))
    seen = torch.stack([ax * bx, ay * by, 0.5 * (ax * by + ay * bx)], dim=-1)
    dual = 2.0 * torch.stack([px * qx, py * qy, px * qy + py * qx], dim=-1)
    return dual[..., :, None] * seen[..., None, :]


def linear_curvatures(points: Bilinear) -> Float[Tensor, "m p 3 12"]:
    """Curvatures of the bilinear rotations."""
    x, y = points.slopes.unbind(2)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, dim=-1).flatten(-2) for row in ((zero, x, zero), (zero, zero, y), (zero, y, x))]
    return torch.stack(rows, dim=2)


def quadratic_curvatures(points: Bilinear, tangent: Float[Tensor, "m 4 2"]) -> Float[Tensor, "m p 3 4"]:
    """Curvatures of a unit of Delta_k on each side."""
    xi, eta = points.xi, points.eta
    along = torch.stack([-xi * (1 - eta), (1 - eta**2) / 2, -xi * (1 + eta), -(1 - eta**2) / 2], dim=-1)
    across = torch.stack([-(1 - xi**2) / 2, -eta * (1 + xi), (1 - xi**2) / 2, -eta * (1 - xi)], dim=-1)
    slopes = torch.linalg.solve(points.jacobian, torch.stack([along, across], dim=1).expand(len(tangent), -1, -1, -1))
    (x, y), (tx, ty) = slopes.unbind(2), tangent[:, None].unbind(-1)
    return torch.stack([x * tx, y * ty, x * ty + y * tx], dim=2)


def shear_strains(points: Bilinear, along: Float[Tensor, "m 4 f"]) -> Float[Tensor, "m p 2 f"]:
    """Shear strains from the covariant ones of the sides 12, 23, 34, 41 (in the sense of the cell's outline)."""
    xi, eta = points.xi[:, None], points.eta[:, None]
    one, two, three, four = along[:, None].unbind(2)
    covariant = torch.stack([(1 - eta) * one - (1 + eta) * three, (1 + xi) * two - (1 - xi) * four], dim=2)
    return torch.linalg.solve(points.jacobian, 0.5 * covariant)
