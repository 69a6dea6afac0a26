"""A quadrilateral membrane with corner drilling freedoms that keeps its accuracy in slender, slanted cells, of any laminate.

Freedoms of a corner: u, v, theta (a real in-plane rotation, no penalty).

mean     strain from the work of constant stresses on the sides (sides.py): any patch test passes
forces   that run linearly over the cell, in four states of equilibrium, from their work on the same sides (quad_states.py,
         inner_forces.py). They follow the laminate; so strips of any ply angle bend in their plane as they should
drill    rotations that no stress does work on: theta = 1 and theta = (1, -1, 1, -1) without displacement, with one strain D
         each, at separate points; they vanish for rigid motions, constant strains and the four states of the isotropic mean.
         Long cells in a single row get less of them: there theta = 1 is bending by a shear force, too, whose energy falls with
         the cell's width over its length. With neighbors on one or both long sides this bending is shear of the whole; with
         less of them, thick plates of such cells would have spurious frequencies below their own

Rectangles of any laminate bend exactly; one row of isotropic parallelograms or trapezoids of 45 degrees, 5 : 1, within 0.1 %.
A membrane without drilling freedoms that passes the patch test cannot bend in trapezoids at all (MacNeal, 1987).

softness    r >= 0 of curved shells (triangle.py): the bending of the sides in the mean by 1 / (1 + r / 10), and in forces and
            drill the rotations are drawn from theta to theta*(u), where they cost nothing, by 1 - 1 / sqrt(1 + 70 r). Less in
            the mean locks hemispheres, more pinched cylinders; more of the other bends the roof too much

Assumed: nu of the laminate's isotropic mean in drill and theta*; small strains. Rank 9, exact rigid-body motion.
Source: sides that bend as parabolas: D. J. Allman, Comput. Struct. 19 (1984) 1-8; stresses that work on them: M. A. Aminpour,
Int. J. Numer. Methods Eng. 33 (1992) 19-38; R. H. MacNeal, Int. J. Numer. Methods Eng. 24 (1987) 1793-1799.
Checked in tests/fem/elements/test_quad.py, tests/fem/elements/test_slender_cells.py, tests/contracts/test_shell_elements.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmbd.fem.elements.inner_forces import CellForces, InnerForces, unit_laws, zero_mean_functions
from torchmbd.fem.elements.quad_shape import Bilinear, middle
from torchmbd.fem.elements.quad_states import bending, displacements, side_work, stresses
from torchmbd.fem.elements.sides import mean_strain

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

    def pair(p: Tensor, q: Tensor) -> Tensor:
        return torch.stack([p[:, 0] * q[:, 0], p[:, 1] * q[:, 1], p[:, 0] * q[:, 1] + p[:, 1] * q[:, 0]], dim=-1)

    return size[:, None, None] * torch.stack([DRILL[0] * pair(a, b), DRILL[1] * (pair(a, a) - pair(b, b))], dim=1)


def _softened(forces: InnerForces, drill: Tensor, S: Tensor, softness: Tensor) -> Float[Tensor, "m 12 12"]:
    """Return the map of the freedoms that moves rotations towards those of least energy in forces and drill."""
    A = torch.linalg.inv(S)
    of_forces = forces.work.mT @ CellForces(forces).law(A, torch.zeros_like(A))[:, :4, :4] @ forces.work
    K = of_forces + torch.einsum("mdsf,mst,mdtg->mfg", drill, A, drill)
    # not solve: its tangents under vmap are wrong (torch 2.13)
    best = -torch.linalg.inv(K[:, _THETA][:, :, _THETA]) @ K[:, _THETA][:, :, _PLANE]
    kept = 1.0 / (1.0 + HIGHER_SOFTNESS * softness).sqrt()
    unit, kept = torch.eye(12, dtype=K.dtype), kept[:, None, None]
    turns = kept * unit[_THETA] + (1.0 - kept) * (best @ unit[_PLANE])
    return unit.expand(len(K), 12, 12).index_copy(1, torch.tensor(_THETA), turns)
