"""Curvatures and transverse shear strains of the discrete Kirchhoff-Mindlin quadrilateral (DKMQ).

Degrees of freedom of a corner: w, beta_x, beta_y as in triangle.py. The rotation gets a quadratic part along each side k,

    beta = sum_i N_i beta_i + sum_k P_k Delta_k t_k,      P = (1 - xi^2)(1 -+ eta) / 2,  (1 - eta^2)(1 +- xi) / 2

and the gap of a side is shared between bending (Delta_k) and shear (gamma_k), see sides.py. Inside, the covariant shear
strains run linearly between opposite sides (MITC4), but for edges, see below. Thin cells get the discrete Kirchhoff
quadrilateral, thick ones MITC4; no locking between. Rotations fit at the sides, so constant moments pass any patch test.

Left so, thin plates are too flexible: a clamped square with 8 x 8 cells by 1.8 % under a central load, one of 5 : 1 by 6 %, a
clamped rhombus of 40 degrees under uniform load by 38 %. Three corrections of what the curvature has beyond its mean over
the cell; the mean, and with it the patch test, stays:

twist       of w = x^2 y the corners see beta_x = -2 x y, but not how beta_y = -x^2 runs between them: half of the twist. In
            thin plates twist is twice d beta_xi / d eta, as d beta_eta / d xi is the same; so the twist of the bilinear
            rotations (component along both medians) counts 1 + 1 / (1 + phi)^3 times, phi the mean of the four sides: once
            where cells are small enough to show the layers at free edges in which shear takes the twist
direction   of w = xi^3 in a slanted cell only the rotation about the other median is a parabola: the quadratic parts point
            along d_k instead of t_k, with d_k . t_k = 1, d_k . b = 0, b the median across. So the curvature of
            all cubic w is exact in thin parallelograms
quadratic   what the quadratic parts add counts 1 + (h_k / |b|)^6 / 2 times in the energy, 1.6 at most, h_k the part of the
            median along the side that is normal to b: 1.5 times in squares, once in slanted cells and along short sides

Then 0.4 %, 1.3 % and 5 %.

edges       at a free edge twist ends in a layer of shear along the edge, which dies away as exp(-y / l), l^2 = D66 / As. So
            where a side has no other cell, the strain is a constant, as the opposite side has it, and a linear rest with the
            weight of such a layer in the energy, w^2 = 3 (z coth z - 1) / z^2, z the cell's width over l, half of it where
            the opposite side is free as well. Torsion of long strips: with one cell across 3 % too stiff, with two 1 %, not
            14 %. Clamped edges and planes of symmetry are taken for free, too, which cells of a few h do not notice
Source: I. Katili, A new discrete Kirchhoff-Mindlin element based on Mindlin-Reissner plate theory and assumed shear
strain fields, Part II, Int. J. Numer. Methods Eng. 36 (1993) 1885-1908, doi:10.1002/nme.1620361107; K.-J. Bathe and
E. N. Dvorkin, Int. J. Numer. Methods Eng. 21 (1985) 367-383 (MITC4).
Checked in tests/fem/elements/test_quad.py, tests/contracts/test_shell_elements.py, tests/validation/test_twisted_strip.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmbd.fem.elements.quad_shape import Bilinear, middle
from torchmbd.fem.elements.sides import dyad, gaps, quad_size2, split_gaps
from torchmbd.fem.materials import IsotropicMean

#: Factors of the quadratic parts in the bending energy of squares, and of long cells.
SQUARE, LONG = 1.5, 1.6


class ShearVariation(NamedTuple):
    """Variation of the shear strains from side 12 to 34 and from 41 to 23: c + weight (linear - c).

    c: the constant strain that the one side has, or the other, or both in the mean: `first` and 1 - `first` of them
    """

    first: Float[Tensor, "m 2"]
    weight: Float[Tensor, "m 2"]


def plate_strains(
    corners: Float[Tensor, "m 4 2"],
    points: Bilinear,
    mean: IsotropicMean,
    side_area: Float[Tensor, "m 4"],
    at_boundary: Bool[Tensor, "m 4"],
) -> tuple[Float[Tensor, "m p 3 12"], Float[Tensor, "m p 2 12"]]:
    """Return curvatures and shear strains at the points of an integration rule.

    side_area: mean area of the cells at each side [m2]; at_boundary: sides that no other cell shares
    """
    mean = mean.of_cells(len(corners))
    gap, tangent, length = gaps(corners)
    size2 = quad_size2(length, side_area)
    delta, side_shear = split_gaps(gap, mean.shear_length, size2)
    share = (points.weight / points.weight.sum(1, keepdim=True))[..., None, None]
    linear, quadratic = linear_curvatures(points), quadratic_curvatures(points, tangent)
    constant = (share * (linear + quadratic @ delta[:, None])).sum(1, keepdim=True)
    higher = linear - (share * linear).sum(1, keepdim=True)
    phi = _mean_share(mean, size2)[:, None, None, None]
    medians = middle(corners).jacobian[:, 0]
    twisted = higher + _twist(medians)[:, None] @ higher / (1.0 + phi) ** 3
    root = _quadratic_weight(medians).sqrt()
    bowed = quadratic_curvatures(points, root[..., None] * _directions(medians, tangent))
    bowed = (bowed - (share * bowed).sum(1, keepdim=True)) @ delta[:, None]
    variation = _shear_variation(medians, at_boundary, mean.layer_length)
    return constant + twisted + bowed, shear_strains(corners, points, side_shear, variation)


def curvature_slopes(
    corners: Float[Tensor, "m 4 2"], points: Bilinear, mean: IsotropicMean, side_area: Float[Tensor, "m 4"]
) -> tuple[Float[Tensor, "m 2 3 12"], Float[Tensor, " m"]]:
    """Return derivatives of the curvatures by x and y, and the share of bending in the gaps.

    The weight of the quadratic parts in the energy makes them smaller in solutions, so here they are multiplied by it.
    """
    mean = mean.of_cells(len(corners))
    gap, tangent, length = gaps(corners)
    size2 = quad_size2(length, side_area)
    delta, _ = split_gaps(gap, mean.shear_length, size2)
    medians = middle(corners).jacobian[:, 0]
    along = _quadratic_weight(medians)[..., None] * _directions(medians, tangent)
    curvature = linear_curvatures(points)
    curvature = curvature + _twist(medians)[:, None] @ curvature + quadratic_curvatures(points, along) @ delta[:, None]
    share = (points.weight / points.weight.sum(1, keepdim=True))[..., None]
    x = points.position - (share * points.position).sum(1, keepdim=True)
    nearest = torch.linalg.solve((share * x).mT @ x, (share * x).mT)  # linear field
    phi = _mean_share(mean, size2)
    return torch.einsum("mdp,mpsf->mdsf", nearest, curvature), 1.0 / (1.0 + phi)


def _mean_share(mean: IsotropicMean, size2: Float[Tensor, "m 4"]) -> Float[Tensor, " m"]:
    """Return phi, the mean of the four sides."""
    return (mean.shear_length**2)[:, None].div(size2).mean(1)


def _shear_variation(
    medians: Float[Tensor, "m 2 2"], at_boundary: Bool[Tensor, "m 4"], layer: Float[Tensor, " m"]
) -> ShearVariation:
    """Return the variation of the shear strains in cells at free edges."""
    width = 2.0 * torch.linalg.det(medians)[:, None] / medians.norm(dim=-1)
    first, second = at_boundary[:, [0, 3]].double(), at_boundary[:, [2, 1]].double()
    z = (width / layer[:, None] / (first + second).clamp_min(1.0)).clamp_min(0.01)
    weight = (3.0 * (z / torch.tanh(z) - 1.0)).sqrt() / z
    return ShearVariation(0.5 * (1.0 + second - first), torch.where(first + second > 0.0, weight, 1.0))


def _directions(medians: Float[Tensor, "m 2 2"], tangent: Float[Tensor, "m 4 2"]) -> Float[Tensor, "m 4 2"]:
    """Return d_k of the four sides (module header)."""
    normal = torch.stack([-medians[..., 1], medians[..., 0]], dim=-1)
    across = normal.flip(1).repeat(1, 2, 1)  # to the median that crosses the side's own
    return across / (across * tangent).sum(-1, keepdim=True)


def _quadratic_weight(medians: Float[Tensor, "m 2 2"]) -> Float[Tensor, "m 4"]:
    """Return the factors of the quadratic parts of the four sides in the energy."""
    ratio = torch.linalg.det(medians)[:, None] / medians.norm(dim=-1).flip(1).square()  # h / |b|
    return (1.0 + (SQUARE - 1.0) * ratio**6).clamp_max(LONG).repeat(1, 2)


def _twist(medians: Float[Tensor, "m 2 2"]) -> Float[Tensor, "m 3 3"]:
    """The part of a curvature that is twist of two medians: kappa_ab = a . kappa . b, times the dual vectors of a and b."""
    # Of a curvature, whose third number is 2 kappa_xy.
    twist = dyad(*medians.unbind(1)) * medians.new_tensor([1.0, 1.0, 0.5])
    dual = 2.0 * dyad(*torch.linalg.inv(medians).unbind(-1))
    return dual[..., :, None] * twist[..., None, :]


def linear_curvatures(points: Bilinear) -> Float[Tensor, "m p 3 12"]:
    """Curvatures of the bilinear rotations."""
    x, y = points.slopes.unbind(2)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, dim=-1).flatten(-2) for row in ((zero, x, zero), (zero, zero, y), (zero, y, x))]
    return torch.stack(rows, dim=2)


def quadratic_curvatures(points: Bilinear, along: Float[Tensor, "m 4 2"]) -> Float[Tensor, "m p 3 4"]:
    """Curvatures of a unit of Delta_k on each side, which is a rotation along a given direction."""
    xi, eta = points.xi, points.eta
    by_xi = torch.stack([-xi * (1 - eta), (1 - eta**2) / 2, -xi * (1 + eta), -(1 - eta**2) / 2], dim=-1)
    by_eta = torch.stack([-(1 - xi**2) / 2, -eta * (1 + xi), (1 - xi**2) / 2, -eta * (1 - xi)], dim=-1)
    slopes = torch.linalg.solve(points.jacobian, torch.stack([by_xi, by_eta], dim=1).expand(len(along), -1, -1, -1))
    return dyad(slopes.mT, along[:, None]).mT


def shear_strains(
    corners: Float[Tensor, "m 4 2"],
    points: Bilinear,
    along: Float[Tensor, "m 4 f"],
    variation: ShearVariation | None = None,
) -> Float[Tensor, "m p 2 f"]:
    """Shear strains from those of the sides 12, 23, 34, 41 (in the sense of the cell's outline)."""
    half = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=along.dtype)[:, None] * 0.5  # both of a pair in one sense
    side = half * (corners.roll(-1, dims=1) - corners)
    covariant = half * (corners.roll(-1, dims=1) - corners).norm(dim=-1, keepdim=True) * along
    start, end = [0, 3], [2, 1]
    contravariant = torch.linalg.inv(points.jacobian)  # not solve: its tangents under vmap are wrong (torch 2.13)
    t = torch.stack([points.eta, points.xi], dim=-1)[..., None]

    def between(value: Tensor) -> Tensor:
        return contravariant @ (0.5 * ((1.0 - t) * value[:, None, start] + (1.0 + t) * value[:, None, end]))

    if variation is None:
        return between(covariant)
    first = variation.first[..., None]
    known, values = (first * x[:, start] + (1.0 - first) * x[:, end] for x in (side, covariant))
    constant = torch.linalg.inv(known) @ values
    rest = covariant - side @ constant
    weight = variation.weight[:, [0, 1, 0, 1], None]
    return constant[:, None] + between(weight * rest)
