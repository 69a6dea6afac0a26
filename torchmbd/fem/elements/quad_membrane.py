"""A quadrilateral membrane with drilling rotations at its corners, accurate in slender, slanted cells, for any laminate.

Degrees of freedom of a corner: u, v, theta (a real in-plane rotation, no penalty).

mean     strain from the work of constant stresses on the sides (sides.py): any patch test passes
forces   that run linearly over the cell, in four states of equilibrium, from their work on the same sides (below, and
         inner_forces.py). They follow the laminate; so strips of any ply angle bend in their plane as they should
drill    rotations that no stress does work on: theta = 1 and theta = (1, -1, 1, -1) without displacement, with one strain D
         each, at separate points; they vanish for rigid motions, constant strains and the four states of the isotropic mean.
         Long cells in a single row get less of them: there theta = 1 is bending by a shear force, too, whose energy falls with
         the cell's width over its length. With neighbors on one or both long sides this bending is shear of the whole; with
         less of them, thick plates of such cells would have spurious frequencies below their own

Rectangles of any laminate bend exactly; one row of isotropic parallelograms or trapezoids of 45 degrees, 5 : 1, within 0.1 %.
A membrane without drilling degrees of freedom that passes the patch test cannot bend in trapezoids at all (MacNeal, 1987).

softness    r >= 0 of curved shells (triangle.py): the bending of the sides in the mean by 1 / (1 + r / 10), and in forces and
            drill the rotations are drawn from theta to theta*(u), where they cost nothing, by 1 - 1 / sqrt(1 + 70 r). Less in
            the mean locks hemispheres, more pinched cylinders; more of the other bends the roof too much

The four states of plane stress in equilibrium,

    sigma_b (xx, yy, xy):   (y, 0, 0),  (0, x, 0),  (x, 0, -y),  (0, y, -x)

belong to any material: strains S sigma_b are linear, hence compatible, with displacements that are quadratic,

    u = a1 x^2 / 2 + a2 x y + p y^2 / 2,   v = b1 x y + b2 y^2 / 2 + q x^2 / 2,   theta = ((b1 - p) y + (q - a2) x) / 2

of eps = (a1 x + a2 y, b1 x + b2 y, c1 x + c2 y), p = c2 - b1, q = c1 - a2. On the sides of a cell, which stretch linearly and
bend as parabolas, the tractions t_b work

    W_b u = sum_k int t_b . u_k ds,     u_k = (1 - s) u_i + s u_j + L_k / 2 s (1 - s) (theta_j - theta_i) n_k

Bending of the fibers along a median: stress e o e times the distance across. Two of the four states are that.
Coordinates from the centroid, in units of the square root of the area.
Assumed: nu of the laminate's isotropic mean in drill and theta*; small strains. Rank 9, exact rigid-body motion.
Source: sides that bend as parabolas: D. J. Allman, Comput. Struct. 19 (1984) 1-8; stresses that work on them: M. A. Aminpour,
Int. J. Numer. Methods Eng. 33 (1992) 19-38; R. H. MacNeal, Int. J. Numer. Methods Eng. 24 (1987) 1793-1799; bending along
medians: T. H. H. Pian and K. Sumihara, Int. J. Numer. Methods Eng. 20 (1984) 1685-1695.
Checked in tests/fem/elements/test_quad_membrane.py, tests/fem/elements/test_quad.py, tests/fem/elements/test_slender_cells.py,
tests/contracts/test_shell_elements.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmbd.fem.elements.inner_forces import CellForces, InnerForces, unit_laws, zero_mean_functions
from torchmbd.fem.elements.quad_shape import Bilinear, middle
from torchmbd.fem.elements.sides import dyad, mean_strain


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


#: Strains per unit of theta = 1 and of theta = (1, -1, 1, -1) in a square.
DRILL = (0.6, 0.15)
#: Of the mean and of the rest, per unit of r.
MEAN_SOFTNESS, HIGHER_SOFTNESS = 0.1, 70.0

_THETA, _PLANE = [2, 5, 8, 11], [0, 1, 3, 4, 6, 7, 9, 10]


class Membrane(NamedTuple):
    """Rows on (u, v, theta) x 4: the mean strain, the two strains of `drill`, and the forces, whose curvature is zero here."""

    mean: Float[Tensor, "m 3 12"]
    drill: Float[Tensor, "m 2 3 12"]
    forces: InnerForces


def membrane(
    corners: Float[Tensor, "m 4 2"],
    points: Bilinear,
    poisson: float | Float[Tensor, " m"],
    softness: Float[Tensor, " m"],
    at_boundary: Bool[Tensor, "m 4"],
) -> Membrane:
    """Return the membrane of every cell; at_boundary: sides that no other cell shares."""
    area = points.weight.sum(1)
    size = area.sqrt()[:, None, None]
    center = (points.weight[..., None] * points.position).sum(1, keepdim=True) / area[:, None, None]
    x = (corners - center) / size
    nu = torch.as_tensor(poisson, dtype=x.dtype).expand(len(x))
    unit, none = torch.ones_like(nu), torch.zeros_like(nu)
    flexible = torch.stack([unit, -nu, none, -nu, unit, none, none, none, 2.0 * (1.0 + nu)], -1)
    flexible = flexible.unflatten(-1, (3, 3))
    per_length = torch.cat([1.0 / size, 1.0 / size, torch.ones_like(size)], dim=-1).repeat(1, 1, 4)
    drill_rows = (torch.linalg.inv(_fields(x, flexible)) * per_length)[:, 10:, None]
    drill = _drill_strains(corners, at_boundary)[..., None] * drill_rows
    bent = bending(middle(x).jacobian[:, 0])
    basis = torch.cat([bent, torch.linalg.qr(bent, mode="complete").Q[..., 2:]], dim=-1)  # of the states, bending first
    work = basis.mT @ side_work(x)
    states = stresses((points.position - center) / size) @ basis[:, None]
    forces = InnerForces(
        area,
        torch.einsum("mep,mpsa->mesa", zero_mean_functions(points.weight), states),
        work * per_length,
        work @ displacements(x, unit_laws()) @ bent,
        torch.zeros(len(x), 3, 3, 12, dtype=x.dtype),
    )
    soft = _softened(forces, drill, flexible, softness)
    mean = mean_strain(corners, area, (1.0 / (1.0 + MEAN_SOFTNESS * softness))[:, None].expand(-1, 4))
    return Membrane(mean, drill @ soft[:, None], forces._replace(work=forces.work @ soft))


def _fields(x: Float[Tensor, "m 4 2"], S: Float[Tensor, "m 3 3"]) -> Float[Tensor, "m 12 12"]:
    """Values (u, v, theta) x 4 of twelve fields, columns: 3 rigid, 3 constant, 4 linear, 2 left for drill."""
    X, Y = x.unbind(-1)
    none, unit = torch.zeros_like(X), torch.ones_like(X)
    sign = unit * x.new_tensor([1.0, -1.0, 1.0, -1.0])
    flat = [(unit, none, none), (none, unit, none), (-Y, X, unit), (X, none, none), (none, Y, none), (Y, X, none)]
    flat, drill = (
        torch.stack([torch.stack(f, dim=-1).flatten(1) for f in fields], dim=-1)
        for fields in (flat, [(none, none, unit), (none, none, sign)])
    )
    return torch.cat([flat, displacements(x[:, None], S).squeeze(1), drill], dim=-1)


def _drill_strains(corners: Float[Tensor, "m 4 2"], at_boundary: Bool[Tensor, "m 4"]) -> Float[Tensor, "m 2 3"]:
    """The two strains D: shear of the medians, and one median stretched, the other shortened; less in long cells of a row."""
    medians = middle(corners).jacobian[:, 0]
    squat = 2.0 * torch.linalg.det(medians) / (medians**2).sum((1, 2))  # 1 in a square, 2 width / length in a long cell
    length = medians.norm(dim=-1)
    row = torch.where(
        length[:, 0] > length[:, 1], at_boundary[:, 0] & at_boundary[:, 2], at_boundary[:, 1] & at_boundary[:, 3]
    )
    size = torch.where(row, squat, 1.0)
    a, b = (medians / length[..., None]).unbind(1)
    return size[:, None, None] * torch.stack([DRILL[0] * dyad(a, b), DRILL[1] * (dyad(a, a) - dyad(b, b))], dim=1)


def _softened(forces: InnerForces, drill: Tensor, S: Tensor, softness: Tensor) -> Float[Tensor, "m 12 12"]:
    """Return the map of the degrees of freedom that moves rotations towards those of least energy in forces and drill."""
    A = torch.linalg.inv(S)
    of_forces = forces.work.mT @ CellForces(forces).law(A, torch.zeros_like(A))[:, :4, :4] @ forces.work
    K = of_forces + torch.einsum("mdsf,mst,mdtg->mfg", drill, A, drill)
    # not solve: its tangents under vmap are wrong (torch 2.13)
    best = -torch.linalg.inv(K[:, _THETA][:, :, _THETA]) @ K[:, _THETA][:, :, _PLANE]
    kept = 1.0 / (1.0 + HIGHER_SOFTNESS * softness).sqrt()
    unit, kept = torch.eye(12, dtype=K.dtype), kept[:, None, None]
    turns = kept * unit[_THETA] + (1.0 - kept) * (best @ unit[_PLANE])
    return unit.expand(len(K), 12, 12).index_copy(1, torch.tensor(_THETA), turns)
