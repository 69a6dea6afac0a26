"""Strains of a quadrilateral membrane with corner drilling freedoms that keeps its accuracy in slender trapezoids.

Freedoms of a corner: u, v, theta (a real in-plane rotation, no penalty). The strain is

    eps(x) = mean_strain u  +  H(x) c  +  D d

mean    from the work of constant stresses on sides that bend as beams, alpha = 1 (sides.py): any patch test passes
c       how much of the four plane stress states with linear stresses the twelve freedoms contain; H: their strains less
        the mean. With z = x + i y from the centroid and k = (3 - nu) / (1 + nu) these are (cubic stress functions)

            u + i v = k a z^2 - 2 a* z z*  +  b z*^2,    a, b = 1, i,      theta = 2 (k + 1) Im(a z)

d       what is left: theta = 1 and theta = (1, -1, 1, -1) without displacement, with one strain D each, at points of
        their own. They vanish for all quadratic displacements, so their weights hardly matter

c and d come from the twelve fields (3 rigid, 3 constant, 4 linear, 2 left) taken at the corners and inverted: the matrix is
regular for every convex cell (it fails only where the corners are three and their orthocenter). A membrane without
drilling freedoms that passes the patch test cannot bend in trapezoids (MacNeal, 1987); this one does. The corners of a long
rectangle cannot tell theta = 1 from bending by a shear force; in slanted cells it is this which is meant: the other fields
that the corners see in its cubic displacements are taken off c and d.

softness    r >= 0 of curved shells (triangle.py): alpha / (1 + r), and in H and D the rotations are drawn from theta to
            theta*(u), where they cost nothing, by 1 - 1 / sqrt(1 + 100 r)

Assumed: nu of the laminate's isotropic mean; small strains. Rank 9, exact rigid-body motion.
Source: idea of assumed strains with lumped sides, C. A. Felippa (opt_membrane.py); fields: N. I. Muskhelishvili, Some basic
problems of the mathematical theory of elasticity, chapter 5; R. H. MacNeal, Int. J. Numer. Methods Eng. 24 (1987) 1793-1799.
Checked in tests/elements/test_quad.py, tests/contracts/test_shell_elements.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.elements.opt_membrane import HIGHER_SOFTNESS
from torchmbd.elements.quad_shape import Bilinear, middle
from torchmbd.elements.sides import mean_strain

#: Strains per unit of theta = 1 and of theta = (1, -1, 1, -1).
DRILL = (0.5, 0.15)

#: Which of the twelve fields is theta = 1: it stays as it is.
_LEFT_OUT = (torch.arange(12) == 10)[:, None]

_THETA, _PLANE = [2, 5, 8, 11], [0, 1, 3, 4, 6, 7, 9, 10]


def membrane_strains(
    corners: Float[Tensor, "m 4 2"],
    points: Bilinear,
    poisson: float,
    softness: Float[Tensor, " m"],
) -> Float[Tensor, "m 6 3 12"]:
    """Return E [cell, point, (eps_xx, eps_yy, gamma_xy), (u, v, theta) x 4]; four points, then two with D alone."""
    area = points.weight.sum(1)
    size = area.sqrt()[:, None, None]
    center = (points.weight[..., None] * points.place).sum(1, keepdim=True) / area[:, None, None]
    k = (3.0 - poisson) / (1.0 + poisson)
    fields = _fields((corners - center) / size, k)
    per_length = torch.cat([1.0 / size, 1.0 / size, torch.ones_like(size)], dim=-1).repeat(1, 1, 4)
    amount = torch.linalg.inv(fields)
    seen = amount @ _shear_bending((corners - center) / size, k)[..., None]
    amount = (amount - torch.where(_LEFT_OUT, 0.0, seen) * amount[:, 10:11]) * per_length
    linear = _linear_strains((points.place - center) / size, k) @ amount[:, None, 6:10]
    left = _drill_strains(corners)[..., None] * amount[:, 10:, None]
    higher = torch.cat([linear, left], dim=1)
    weight = torch.cat([points.weight, area[:, None].expand(-1, 2)], dim=1)
    higher = higher @ _softened(higher, weight, poisson, softness)[:, None]
    mean = mean_strain(corners, area, (1.0 / (1.0 + softness))[:, None].expand(-1, 4))
    return torch.cat([mean[:, None] + higher[:, :4], higher[:, 4:]], dim=1)


def _fields(x: Float[Tensor, "m 4 2"], k: float) -> Float[Tensor, "m 12 12"]:
    """Values (u, v, theta) x 4 of the twelve fields, columns."""
    z = torch.complex(*x.unbind(-1))
    none, sign = torch.zeros_like(z.real), torch.ones_like(z.real) * x.new_tensor([1.0, -1.0, 1.0, -1.0])
    rest = torch.zeros_like(z)
    rigid = [(rest + 1.0, none), (rest + 1j, none), (1j * z, none + 1.0)]
    constant = [(rest + z.real, none), (1j * z.imag, none), (0.5j * z.conj(), none)]
    linear = [(k * a * z**2 - 2.0 * (a * z).conj() * z, 2.0 * (k + 1.0) * (a * z).imag) for a in (1.0, 1j)]
    linear += [(b * z.conj() ** 2, none) for b in (1.0, 1j)]
    fields = [*rigid, *constant, *linear, (rest, none + 1.0), (rest, sign)]
    return torch.stack([torch.stack([f.real, f.imag, theta], dim=-1).flatten(1) for f, theta in fields], dim=-1)


def _shear_bending(x: Float[Tensor, "m 4 2"], k: float) -> Float[Tensor, "m 12"]:
    """Values (u, v, theta) x 4 of bending by a shear force along the cell, as far as it is long."""
    z = torch.complex(*x.unbind(-1))
    long, size2 = (z**2).mean(1, keepdim=True), (z.abs() ** 2).mean(1, keepdim=True)
    q2 = (long.abs() / size2) ** 2
    a = 1j * long.conj() * (2.0 - q2) / (3.0 * (k + 1.0) * size2**2)
    b = -2.0 * a * torch.where(q2 > 0.0, long.conj() / long.abs(), 0.0)
    f = k * a * z**3 - 3.0 * (a * z**2).conj() * z - (b * z**3).conj()
    return torch.stack([f.real, f.imag, 3.0 * (k + 1.0) * (a * z**2).imag], dim=-1).flatten(1)


def _linear_strains(z: Float[Tensor, "m p 2"], k: float) -> Float[Tensor, "m p 3 4"]:
    """Strains of the four fields with linear stresses."""
    x, y = z.unbind(-1)
    zero = torch.zeros_like(x)
    sums = [4.0 * (k - 1.0) * x, -4.0 * (k - 1.0) * y, zero, zero]  # eps_xx + eps_yy
    differences = [-4.0 * x, -4.0 * y, 4.0 * x, 4.0 * y]
    shears = [-4.0 * y, 4.0 * x, -4.0 * y, 4.0 * x]
    states = [torch.stack([(s + d) / 2, (s - d) / 2, g], -1) for s, d, g in zip(sums, differences, shears, strict=True)]
    return torch.stack(states, dim=-1)


def _drill_strains(corners: Float[Tensor, "m 4 2"]) -> Float[Tensor, "m 2 3"]:
    """The two strains D: shear of the medians, and one median stretched, the other shortened."""
    medians = middle(corners).jacobian[:, 0]
    a, b = (medians / medians.norm(dim=-1, keepdim=True)).unbind(1)

    def pair(p: Tensor, q: Tensor) -> Tensor:
        return torch.stack([p[:, 0] * q[:, 0], p[:, 1] * q[:, 1], p[:, 0] * q[:, 1] + p[:, 1] * q[:, 0]], dim=-1)

    return torch.stack([DRILL[0] * pair(a, b), DRILL[1] * (pair(a, a) - pair(b, b))], dim=1)


def _softened(E: Tensor, weight: Tensor, poisson: float, softness: Tensor) -> Float[Tensor, "m 12 12"]:
    """The map of the freedoms that draws the rotations to those which cost nothing in E."""
    law = E.new_tensor([[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, (1.0 - poisson) / 2.0]])
    K = torch.einsum("mp,mpsf,st,mptg->mfg", weight, E, law, E)
    best = -torch.linalg.solve(K[:, _THETA][:, :, _THETA], K[:, _THETA][:, :, _PLANE])
    kept = 1.0 / (1.0 + HIGHER_SOFTNESS * softness).sqrt()
    T = torch.eye(12, dtype=E.dtype).repeat(len(E), 1, 1)
    for row, theta in enumerate(_THETA):
        T[:, theta, theta] = kept
        T[:, theta, _PLANE] = (1.0 - kept)[:, None] * best[:, row]
    return T
