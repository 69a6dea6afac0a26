"""Strains of a quadrilateral membrane with corner drilling freedoms that keeps its accuracy in slender, slanted cells.

Freedoms of a corner: u, v, theta (a real in-plane rotation, no penalty). The strain is

    eps(x) = mean_strain u  +  H(x) c  +  D d

mean    from the work of constant stresses on the sides (sides.py): any patch test passes
c       how much there is of the four plane stress states sigma_b with linear stresses: what their tractions t_b work on the
        same sides, which stretch linearly and bend as parabolas; H: the strains of these states, without mean

            c_0 = U^-1 W u,     U_ab = int H_a . sigma_b dA,
            W_b u = sum_k int t_b . u_k ds,     u_k = (1 - s) u_i + s u_j + L_k / 2 s (1 - s) (theta_j - theta_i) n_k

        In complex coordinates z = x + i y from the centroid, with k = (3 - nu) / (1 + nu), the states have the displacements

            u + i v = k a z^2 - 2 a* z z*  +  b z*^2,    a, b = 1, i,      theta = 2 (k + 1) Im(a z)

        Two of the four are pure bending of fibers along a median, linear across them; on the sides their displacements
        along the side are parabolas, which u_k lacks and the other two states would take for their own. So c = (1 - P T Q) c_0
        with T = c_0 of the four states themselves, Q and P = 1 - Q the projections on bending and, in energy, across it
d       what no stress sees: theta = 1 and theta = (1, -1, 1, -1) without displacement, with one strain D each, at points of
        their own; they vanish for rigid motions, constant strains and the four states. Long cells get less of them: the corners
        cannot tell theta = 1 from bending by a shear force, whose energy falls with the cell's width over its length

A hybrid element whose stresses are those of the isotropic mean, so that its stiffness is linear in the laminate. Rectangles
bend exactly; one row of parallelograms or trapezoids of 45 degrees, 5 : 1, within 0.1 %. A membrane without drilling freedoms
that passes the patch test cannot bend in trapezoids at all (MacNeal, 1987).

softness    r >= 0 of curved shells (triangle.py): the bending of the sides in the mean by 1 / (1 + r), and in H and D the
            rotations are drawn from theta to theta*(u), where they cost nothing, by 1 - 1 / sqrt(1 + 100 r)

Assumed: nu of the laminate's isotropic mean; small strains. Rank 9, exact rigid-body motion.
Source: sides that bend as parabolas: D. J. Allman, Comput. Struct. 19 (1984) 1-8; stresses that work on them: M. A. Aminpour,
Int. J. Numer. Methods Eng. 33 (1992) 19-38; bending of fibers along medians: T. H. H. Pian and K. Sumihara, Int. J. Numer.
Methods Eng. 20 (1984) 1685-1695; fields: N. I. Muskhelishvili, Some basic problems of the mathematical theory of elasticity,
chapter 5; R. H. MacNeal, Int. J. Numer. Methods Eng. 24 (1987) 1793-1799.
Checked in tests/elements/test_quad.py, tests/contracts/test_shell_elements.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.elements.opt_membrane import HIGHER_SOFTNESS
from torchmbd.elements.quad_shape import Bilinear, middle
from torchmbd.elements.sides import mean_strain

#: Strains per unit of theta = 1 and of theta = (1, -1, 1, -1) in a square.
DRILL = (0.65, 0.15)

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
    x, k = (corners - center) / size, (3.0 - poisson) / (1.0 + poisson)
    law = corners.new_tensor([[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, (1.0 - poisson) / 2.0]])
    per_length = torch.cat([1.0 / size, 1.0 / size, torch.ones_like(size)], dim=-1).repeat(1, 1, 4)
    states, fields = _linear_strains((points.place - center) / size, k), _fields(x, k)
    share = points.weight / area[:, None]
    energy = torch.einsum("mp,mpsa,st,mptb->mab", share, states, law, states)
    amount = torch.linalg.solve(energy, _work(x, law, k))
    Q = _bending(middle(x).jacobian[:, 0], energy, law, k)
    seen = amount @ fields[:, :, 6:10] @ Q
    amount = amount - (seen - Q @ seen) @ amount
    linear = states @ (amount * per_length)[:, None]
    left = _drill_strains(corners)[..., None] * (torch.linalg.inv(fields) * per_length)[:, 10:, None]
    higher = torch.cat([linear, left], dim=1)
    weight = torch.cat([points.weight, area[:, None].expand(-1, 2)], dim=1)
    higher = higher @ _softened(higher, weight, law, softness)[:, None]
    mean = mean_strain(corners, area, (1.0 / (1.0 + softness))[:, None].expand(-1, 4))
    return torch.cat([mean[:, None] + higher[:, :4], higher[:, 4:]], dim=1)


def _work(x: Float[Tensor, "m 4 2"], law: Float[Tensor, "3 3"], k: float) -> Float[Tensor, "m 4 12"]:
    """Work of the four states on the sides, from (u, v, theta) of the corners; cells of area 1."""
    side = x.roll(-1, dims=1) - x
    nx, ny = side[..., 1], -side[..., 0]  # times the length
    sxx, syy, sxy = (law @ _linear_strains(x, k)).unbind(2)  # at the corners [m, 4, states]
    work = x.new_zeros(len(x), sxx.shape[-1], 4, 3)
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


def _bending(
    medians: Float[Tensor, "m 2 2"], energy: Float[Tensor, "m 4 4"], law: Float[Tensor, "3 3"], k: float
) -> Float[Tensor, "m 4 4"]:
    """Q: what of the four states is bending of fibers along a median, stress e o e times the distance across."""
    slopes = (law @ _linear_strains(torch.eye(2, dtype=law.dtype)[None], k)).flatten(
        0, 2
    )  # of the stresses [6, states]
    ex, ey = medians.unbind(-1)
    stress, across = torch.stack([ex * ex, ey * ey, ex * ey], -1), torch.stack([-ey, ex], -1)
    bent = (across[..., None] * stress[..., None, :]).flatten(-2).mT  # [m, 6, median]
    R = torch.linalg.pinv(slopes) @ bent
    return R @ torch.linalg.solve(R.mT @ energy @ R, R.mT @ energy)


def _fields(x: Float[Tensor, "m 4 2"], k: float) -> Float[Tensor, "m 12 12"]:
    """Values (u, v, theta) x 4 of twelve fields, columns: 3 rigid, 3 constant, 4 linear, 2 left for d."""
    z = torch.complex(*x.unbind(-1))
    none, sign = torch.zeros_like(z.real), torch.ones_like(z.real) * x.new_tensor([1.0, -1.0, 1.0, -1.0])
    rest = torch.zeros_like(z)
    rigid = [(rest + 1.0, none), (rest + 1j, none), (1j * z, none + 1.0)]
    constant = [(rest + z.real, none), (1j * z.imag, none), (0.5j * z.conj(), none)]
    linear = [(k * a * z**2 - 2.0 * (a * z).conj() * z, 2.0 * (k + 1.0) * (a * z).imag) for a in (1.0, 1j)]
    linear += [(b * z.conj() ** 2, none) for b in (1.0, 1j)]
    fields = [*rigid, *constant, *linear, (rest, none + 1.0), (rest, sign)]
    return torch.stack([torch.stack([f.real, f.imag, theta], dim=-1).flatten(1) for f, theta in fields], dim=-1)


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
    """The two strains D: shear of the medians, and one median stretched, the other shortened; less in long cells."""
    medians = middle(corners).jacobian[:, 0]
    squat = 2.0 * torch.linalg.det(medians) / (medians**2).sum((1, 2))  # 1 in a square, 2 width / length in a long cell
    a, b = (medians / medians.norm(dim=-1, keepdim=True)).unbind(1)

    def pair(p: Tensor, q: Tensor) -> Tensor:
        return torch.stack([p[:, 0] * q[:, 0], p[:, 1] * q[:, 1], p[:, 0] * q[:, 1] + p[:, 1] * q[:, 0]], dim=-1)

    return squat[:, None, None] * torch.stack([DRILL[0] * pair(a, b), DRILL[1] * (pair(a, a) - pair(b, b))], dim=1)


def _softened(E: Tensor, weight: Tensor, law: Tensor, softness: Tensor) -> Float[Tensor, "m 12 12"]:
    """The map of the freedoms that draws the rotations to those which cost nothing in E."""
    K = torch.einsum("mp,mpsf,st,mptg->mfg", weight, E, law, E)
    best = -torch.linalg.solve(K[:, _THETA][:, :, _THETA], K[:, _THETA][:, :, _PLANE])
    kept = 1.0 / (1.0 + HIGHER_SOFTNESS * softness).sqrt()
    T = torch.eye(12, dtype=E.dtype).repeat(len(E), 1, 1)
    for row, theta in enumerate(_THETA):
        T[:, theta, theta] = kept
        T[:, theta, _PLANE] = (1.0 - kept)[:, None] * best[:, row]
    return T
