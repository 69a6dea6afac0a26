"""The laminated quadrilateral: membrane with drilling degrees of freedom, DKMQ bending and transverse shear, warped cells.

Strains at the 2 x 2 points of Gauss, and at two more that carry membrane strains of the drilling degrees of freedom alone;
membrane forces that vary over the cell (inner_forces.py).

A warped cell stands on its mean plane, its corners at heights z = +d, -d, +d, -d. Shallow shell theory in the cell,

    eps = sym grad u + sym grad z o grad w = sym grad (u + z grad w_0) + sym grad z o (grad w - grad w_0)

w_0     the linear part of w (its gradient at xi = eta = 0): the corners' displacements become u_i + z_i grad w_0, from
        displacements alone, so a rigid rotation strains nothing
rest    bending of a warped cell, with grad w = -beta of the corners; its mean over the cell is kept
bows    a side that is bent deflects by L / 12 (beta_j - beta_i) . t from its chord in the mean; where the chord is inclined
        to the plane, a part of this lies in the plane along the side and belongs to the mean of grad u

So a strip of cells that wind like a screw bends and twists as thin as it is, without stretching.

On curved shells the drilling degrees of freedom are softened as in triangle.py, with r = area (tilt^2 + warp^2) / h^2: the
surface of a warped cell is tilted to its own mean plane, by `warp` in the mean square.
Source: see quad_membrane.py, quad_bending.py; shallow shells: K. Marguerre (1938); forces instead of moments at the corners
of warped cells: R. H. MacNeal, Finite Elements: Their Design and Performance (1994), chapter 9.
Checked in tests/fem/elements/test_quad.py, tests/contracts/test_shell_elements.py, tests/validation/test_curved_shells.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements.facet import Facets
from torchmbd.fem.elements.inner_forces import zero_mean_functions
from torchmbd.fem.elements.quad_bending import curvature_slopes, plate_strains
from torchmbd.fem.elements.quad_membrane import membrane
from torchmbd.fem.elements.quad_shape import Bilinear, gauss, middle
from torchmbd.fem.elements.strains import ShearRecovery, Strains, in_mesh_axes, plate_rows, to_mesh_axes
from torchmbd.fem.materials import IsotropicMean


def quad_strains(plane: Facets, mean: IsotropicMean) -> Strains:
    """Return the strains of every quadrilateral at its six points, and its inner forces."""
    mean, points = mean.of_cells(len(plane.area)), gauss(plane.corners)
    sides = (plane.corners.roll(-1, dims=1) - plane.corners).norm(dim=-1)
    # Mean square of the slope of a bilinear surface: a third of that of its sides, here of the steepest [rad2].
    warp2 = ((plane.height.roll(-1, dims=1) - plane.height) / sides).square().amax(1) / 3.0
    softness = plane.area * (plane.tilt**2 + warp2) / mean.bending_length**2
    flat = membrane(plane.corners, points, mean.poisson, softness, plane.at_boundary)
    constant, drill, work = (_of_corners(plane, rows) for rows in (flat.mean, flat.drill, flat.forces.work))
    warped = _of_slopes(plane, points) + _of_bows(plane)
    constant = constant + torch.nn.functional.pad(warped, (2, 1))
    curvature, shear = (
        torch.cat([rows, torch.zeros_like(rows[:, :2])], dim=1)
        for rows in plate_strains(plane.corners, points, mean, plane.side_area, plane.at_boundary)
    )
    in_plane = torch.cat([constant[:, None].expand(-1, 4, -1, -1, -1), drill], dim=1)
    at = in_mesh_axes(plane.axes, in_plane, curvature, shear)
    weight = torch.cat([points.weight, plane.area[:, None].expand(-1, 2)], dim=1)
    share = points.weight / points.weight.sum(1, keepdim=True)
    center = torch.einsum("mp,mpsf->msf", share, at[:, :4])
    bent = torch.einsum("mep,mpsf->mesf", zero_mean_functions(points.weight), at[:, :4, 3:6])
    forces = flat.forces._replace(work=to_mesh_axes(plane.axes, work), curvature=bent)
    slopes, bending = curvature_slopes(plane.corners, points, mean, plane.side_area)
    slopes = bending[:, None, None, None] * to_mesh_axes(plane.axes, plate_rows(slopes))
    return Strains(at, weight, center, forces, ShearRecovery(slopes, (1.0 - bending)[:, None, None] * center[:, 6:]))


def _of_corners(plane: Facets, rows: Float[Tensor, "m *rows 12"]) -> Float[Tensor, "m *rows 4 6"]:
    """Rows on (u, v, theta) of the corners of the mean plane, on all degrees of freedom of the corners in the cell's axes."""
    flat = rows.unflatten(-1, (4, 3))
    w0 = middle(plane.corners).slopes[:, 0]  # gradient of the linear part [m, 2, 4]
    w = torch.einsum("m...ic,mi,mcj->m...j", flat[..., :2], plane.height, w0)
    u, v, theta = flat.unbind(-1)
    zero = torch.zeros_like(w)
    return torch.stack([u, v, w, zero, zero, theta], -1)


def _of_slopes(plane: Facets, points: Bilinear) -> Float[Tensor, "m 3 4 3"]:
    """Mean of sym grad z o (grad w - grad w_0) with grad w = -beta, of w, phi_x, phi_y of the corners."""
    w0 = middle(plane.corners).slopes[:, 0]
    zx, zy = torch.einsum("mpci,mi->cmp", points.slopes, plane.height)[..., None]
    share = (points.weight / points.weight.sum(1, keepdim=True))[..., None, None]
    N = points.shape.expand(len(w0), -1, -1)

    def mean(wx: Tensor, wy: Tensor) -> Tensor:
        return (share * torch.stack([zx * wx, zy * wy, zx * wy + zy * wx], dim=2)).sum(1)

    return torch.stack([mean(-w0[:, None, 0], -w0[:, None, 1]), mean(0.0 * N, N), mean(-N, 0.0 * N)], dim=-1)


def _of_bows(plane: Facets) -> Float[Tensor, "m 3 4 3"]:
    """Mean strain of the sides' bows, which have a part in the plane where a side is inclined to it."""
    side, rise = plane.corners.roll(-1, dims=1) - plane.corners, plane.height.roll(-1, dims=1) - plane.height
    length2 = (side**2).sum(-1)
    tx, ty = (side / length2.sqrt()[..., None]).unbind(-1)
    pulled = torch.stack([tx * ty, -tx * ty, ty**2 - tx**2], dim=-1)  # n o t of every side
    size = -rise * length2.sqrt() / 12.0 / plane.area[:, None]
    turn = torch.stack([torch.zeros_like(tx), -ty, tx], dim=-1)  # beta . t of (w, phi_x, phi_y)
    of_side = torch.einsum("mk,mks,mkf->mskf", size, pulled, turn)
    return of_side.roll(1, dims=2) - of_side
