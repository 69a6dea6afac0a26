"""Geometric stiffness of shells: membrane forces act on the slopes of all three displacements.

    u' Kg u = integral of N_ab u,a . u,b       a, b: the axes of a cell's plane

u     between the corners (linear, bilinear), and on each side the parabola of its bending: (L / 8) t x (phi_j - phi_i) at the
      middle, of the rotations about axes in the plane. So sines are exact to the fourth order of the cells' size, and plates
      that give way in shear need nothing else, for the parabola has no part of that slope
N     at the points of the cells. Of triangles from the strains there; of quadrilaterals the mean and the forces that vary over
      the cell (inner_forces.py), so one cell over the depth of a strip carries its bending

A rigid rotation does the work of loads in the plane, exactly. Shear forces and moments of the plates are not in it: what they
do on slopes is smaller than K's own part by strains.
Source: the nonlinear part of Green's strains; the parabolas are the linked interpolation of R. L. Taylor and F. Auricchio,
Int. J. Numer. Methods Eng. 36 (1993) 3057-3066. Checked in tests/fem/elements/test_geometric.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements.facet import Facets
from torchmbd.fem.elements.geometric import StressedCells, corner_motions
from torchmbd.fem.elements.inner_forces import CellForces
from torchmbd.fem.elements.plate import PlateMatrices
from torchmbd.fem.elements.quad_shape import ETA, XI, gauss
from torchmbd.fem.elements.strains import Strains
from torchmbd.fem.elements.triangle import barycentric_gradients
from torchmbd.fem.materials import ENTRIES, LaminateStiffness
from torchmbd.math.rigid_motion import hat


def stressed_shells(
    matrices: PlateMatrices,
    entries: Float[Tensor, "*lanes 21"],
    motion: Float[Tensor, "*lanes n 6 k"],
    mean: Float[Tensor, "*lanes 3"] | None,
    held: Float[Tensor, "*lanes 3"] | None = None,
) -> list[StressedCells]:
    """Return the cells of each kind under the membrane forces of k motions; entries and mean as in `PlateMatrices.values`.

    held   forces N of free strains, which are subtracted; of several laminates [*lanes, laminates, 3]
    """
    zones = matrices.zones.split([len(group.shape) for group in matrices.kinds.values()])
    numbers = entries if matrices.several else entries[..., None, :]
    assert numbers.shape[-1] == len(ENTRIES)
    law = LaminateStiffness.of(numbers)
    stressed = []
    for (kind, cells), (cell, variant), zone in zip(matrices.kinds.items(), matrices.variants, zones, strict=True):
        A, B = (X[..., cell.laminate, :, :] for X in (law.A, law.B))
        weight = cells.strains.weight[cell.shape]
        if mean is None:
            strains, inner = Strains(cells.strains.at[cell.shape], weight, cells.strains.center[cell.shape]), cell.inner
            rows = _force_rows(strains, inner, A, B)  # [*lanes, variants, p, 3, f]
        else:
            lanes = A.shape[:-3]
            strains = cells.moved(cell, matrices.of_lanes(mean, lanes))
            inner = None if strains.forces is None else CellForces(strains.forces)
            rows = _force_rows(strains, inner, A.reshape(-1, 3, 3), B.reshape(-1, 3, 3))
            rows = rows.reshape(*lanes, len(weight), *rows.shape[1:])
        p = rows.shape[-3]
        N = rows.flatten(-3, -2)[..., variant, :, :] @ corner_motions(cells.corners, motion)  # [*lanes, m, 3 p, k]
        N = N.unflatten(-2, (p, 3)).movedim(-1, -4)  # [*lanes, k, m, p, 3]
        if held is not None:
            of_cells = held[..., zone, :] if matrices.several else held[..., None, :]
            area = cells.strains.weight[cells.shape][:, :p, None]  # those of drilling freedoms stand behind
            factors = held.new_tensor([1.0, 2.0, 1.0])
            N = N - (factors * of_cells[..., [0, 2, 1]])[..., None, :, None, :] * area
        stressed.append(StressedCells(cells.corners, slopes(kind, cells.facets), N))
    return stressed


def _force_rows(
    strains: Strains, inner: CellForces | None, A: Float[Tensor, "*lanes v 3 3"], B: Float[Tensor, "*lanes v 3 3"]
) -> Float[Tensor, "*lanes v p 3 f"]:
    """Return N_11, 2 N_12, N_22 at the points, times the area of a point, as rows on the motion of the corners."""
    weight = strains.weight
    if inner is None:
        rows = A[..., None, :, :] @ strains.at[..., :3, :] + B[..., None, :, :] @ strains.at[..., 3:6, :]
    else:
        center, weight = strains.center, weight[:, :4]
        mean = A @ center[..., :3, :] + B @ center[..., 3:6, :]
        amounts = inner.amounts(A, B) @ inner.rows  # of the states that vary over the cell, without mean
        rows = mean[..., None, :, :] + inner.at_points(weight) @ amounts[..., None, :, :]
    rows = rows * weight[..., None, None]
    return torch.stack([rows[..., 0, :], 2.0 * rows[..., 2, :], rows[..., 1, :]], -2)


#: The rows of one kind of cell: displacements u1 u2 u3 by two slopes, of freedoms of the corners.
Rows = Float[Tensor, "m p 2 3 f"]


def slopes(kind: str, plane: Facets) -> Rows:
    """Slopes of the displacements, mesh axes, along both axes of every cell at its points."""
    linear, bows = _triangle(plane) if kind == "triangle" else _quad(plane.corners)
    m, p, _, c = linear.shape
    local = torch.cat([plane.corners, plane.height[..., None]], -1)
    side = (local.roll(-1, dims=1) - local) @ plane.axes  # from each corner to the next, mesh axes
    e3 = plane.axes[:, 2]
    within = torch.eye(3, dtype=side.dtype) - e3[:, :, None] * e3[:, None, :]  # rotations about axes in the plane
    bow = (hat(side) @ within[:, None]) / 8.0  # of the rotation of the end less that of the start [m, side, 3, 3]
    rows = linear.new_zeros(m, p, 2, 3, c, 6)
    rows[..., :3] = torch.einsum("mpac,ij->mpaicj", linear, torch.eye(3, dtype=linear.dtype))
    of_side = torch.einsum("mpac,mcij->mpaicj", bows, bow)
    rows[..., 3:] = of_side.roll(1, dims=-2) - of_side
    return rows.flatten(-2)


def _triangle(plane: Facets) -> tuple[Float[Tensor, "m 3 2 3"], Float[Tensor, "m 3 2 3"]]:
    """Slopes of the corners' functions l and of 4 l_i l_j of the sides 12, 23, 31, at the middles of the sides."""
    grad = barycentric_gradients(plane.corners, plane.area).mT  # [m, 2, corner]
    middle = torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]], dtype=grad.dtype)  # l at the points
    i, j = [0, 1, 2], [1, 2, 0]
    bows = 4.0 * (middle[:, None, i] * grad[:, None][..., j] + middle[:, None, j] * grad[:, None][..., i])
    return grad[:, None].expand(-1, 3, -1, -1), bows


def _quad(x: Float[Tensor, "m 4 2"]) -> tuple[Float[Tensor, "m 4 2 4"], Float[Tensor, "m 4 2 4"]]:
    """The same of a quadrilateral at the points of Gauss: bilinear functions, and (1 - xi^2)(1 - eta) / 2, ..."""
    points = gauss(x)
    xi, eta = points.xi[:, None], points.eta[:, None]
    along = torch.tensor([1.0, 0.0, 1.0, 0.0], dtype=x.dtype)  # sides 12 and 34 run along xi
    end = along * (ETA + ETA.roll(-1)) / 2.0 + (1.0 - along) * (XI + XI.roll(-1)) / 2.0  # where the side lies
    by_xi = along * (-xi) * (1.0 + end * eta) + (1.0 - along) * 0.5 * end * (1.0 - eta**2)
    by_eta = along * 0.5 * end * (1.0 - xi**2) + (1.0 - along) * (-eta) * (1.0 + end * xi)
    natural = torch.stack([by_xi, by_eta], 1)  # [p, 2, sides]
    return points.slopes, torch.linalg.solve(points.jacobian, natural.expand(len(x), -1, -1, -1))
