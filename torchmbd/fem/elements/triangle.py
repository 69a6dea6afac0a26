"""The laminated triangle: OPT membrane with drilling degrees of freedom, DKMT bending and transverse shear.

Strains at the middles of the sides 12, 23, 31, each with a third of the area (strains.py tells their order).

Between facets that are tilted to each other, a bending rotation of one is partly a drilling rotation of its neighbour.
That is as stiff as a membrane, so thin curved shells would lock: by membrane over bending stiffness, a ratio of about

    r = (tilt sqrt(2 area) / h)^2        h = bending_length of the laminate, its thickness if it is homogeneous

The drilling degrees of freedom are softened by r where r is not small. A flat plate has r = 0; on a curved shell r falls with
the fourth power of the mesh size, so the limit is the same.

Membrane: OPT, degrees of freedom u, v, theta_z of a corner (a real in-plane rotation, no penalty). The strain is

    eps(zeta) = (1 / area) L' u  +  3/2 sqrt(beta0) T_e Q(zeta) (theta - theta_0)

basic part   L lumps a constant stress to corner forces (sides.py), alpha_b = 3/2: any patch test passes
higher part  natural strains along the sides, linear in zeta and without mean, driven by the corner rotations less
             the rotation theta_0 of the linear displacement field
beta0        weight of the higher part; 1/2 (1 - 4 nu^2) makes in-plane bending of rectangular cells exact

softness     r: alpha_b / (1 + r) and beta0 / (1 + 100 r). Both are free numbers of the template, so patch tests, rigid
             motions and the rank do not notice; 100 is a compromise of the hemisphere, the twisted beam and the roof in
             tests/validation/test_curved_shells.py

At the middles of the sides the three-point rule integrates the energy exactly. So the stiffness sum_points area/3 E' A E
is linear in the membrane stiffness A, and the same strains couple with bending.
Assumed: homogeneous facet, small strains. Rank 6, exact rigid-body motion.

Bending and shear: DKMT, degrees of freedom w, beta_x, beta_y of a corner (u = z beta_x, v = z beta_y; from rotations: beta_x
= phi_y, beta_y = -phi_x). The rotation gets a quadratic part along each side k = ij (tangent t_k, length L_k),

    beta = sum_i lambda_i beta_i + sum_k 4 lambda_i lambda_j Delta_k t_k

and the gap g_k of a side, its mean shear strain with linear rotations, is shared between bending (Delta_k) and shear (gamma_k)
by phi_k = shear_length^2 / size_k^2 (sides.py).

shear_length^2   12 D / As [m2] with the mean bending stiffness D and the mean shear stiffness As of the laminate
size_k^2         L_k^2, or 4 times the mean area of the triangles at this side if that is less [m2]. In slender cells the
                 shear of a twisted strip changes over their width, not over the length of their sides

Thin plates (phi -> 0) get the discrete Kirchhoff triangle DKT, thick ones (phi -> infinity) linear rotations with the
shear of the sides; no locking between. Inside, gamma is linear. Its mean c and its curl omega are those of the field
with the constant tangential parts gamma_k on the sides (as in MITC3), and of all such fields it has the least energy:

    gamma(x) = c + omega J R x / tr J        R: turn by 90 degrees,  J: mean of x x' over the triangle

(for equilateral triangles it is MITC3's own). Because phi depends on mesh and shear_length only, never on the ply angles,
the stiffness stays linear in D and As. The condition is local: an approximate shear_length changes the error of a given
mesh, not the limit (energy at the side is stationary in the share).
A constant shear with all rotations held is met in the thick limit only: with linear moments the nodes of a thin plate show
the same pattern of gaps at a cost D / L^2 instead of As, and a triangle alone cannot tell them apart. Elements that take
every gap for shear (MITC3) meet it and pay in bending: 0.58 instead of 0.91 of the pinched cylinder with 8 x 8 cells.
Source: C. A. Felippa, A study of optimal membrane triangles with drilling freedoms, Comput. Methods Appl. Mech. Engrg.
192 (2003) 2125-2168, doi:10.1016/S0045-7825(03)00253-6, sections 3-5 and Table 1 (OPT); I. Katili, A new discrete
Kirchhoff-Mindlin element based on Mindlin-Reissner plate theory and assumed shear strain fields, Part I, Int. J. Numer.
Methods Eng. 36 (1993) 1859-1883, doi:10.1002/nme.1620361106.
Checked in tests/fem/elements/test_triangle.py, tests/fem/elements/test_plate_patch.py, tests/contracts/test_shell_elements.py,
tests/validation/test_twisted_strip.py, tests/validation/test_curved_shells.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmbd.fem.elements.facet import Facets
from torchmbd.fem.elements.sides import dyad, gaps, mean_strain, quad_size2, split_gaps
from torchmbd.fem.elements.strains import Strains, in_mesh_axes
from torchmbd.fem.materials import IsotropicMean

_SIDES = ((0, 1), (1, 2), (2, 0))


def plate_strains(
    corners: Float[Tensor, "m 3 2"],
    area: Float[Tensor, " m"],
    shear_length: float | Float[Tensor, " m"],
    side_area: Float[Tensor, "m 3"] | None = None,
    mixed: Bool[Tensor, "m 3"] | None = None,
) -> tuple[Float[Tensor, "m 3 3 9"], Float[Tensor, "m 3 2 9"]]:
    """Return curvatures and shear strains at the middles of the sides 12, 23, 31.

    side_area      mean area of the cells at each side [m2]; None: triangles that stand alone
    mixed          sides with a cell of another kind, whose size is that of quadrilaterals (sides.py); None: there are none
    curvatures     [triangle, point, (kappa_xx, kappa_yy, kappa_xy), (w, beta_x, beta_y) x 3 corners]
    shear strains  [triangle, point, (gamma_xz, gamma_yz), the same freedoms]
    """
    slopes = barycentric_gradients(corners, area)
    gap, tangent, length = gaps(corners)
    at_side = area[:, None].expand(-1, 3) if side_area is None else side_area
    size2 = torch.minimum(length**2, 4.0 * at_side)
    if mixed is not None:
        size2 = torch.where(mixed, quad_size2(length, at_side), size2)
    delta, side_shear = split_gaps(gap, shear_length, size2)
    linear = slopes.new_zeros(len(slopes), 3, 9)
    for i in range(3):
        linear[:, 0, 3 * i + 1] = linear[:, 2, 3 * i + 2] = slopes[:, i, 0]
        linear[:, 1, 3 * i + 2] = linear[:, 2, 3 * i + 1] = slopes[:, i, 1]
    points = []
    for a, b in _SIDES:
        kappa = linear
        for k, (i, j) in enumerate(_SIDES):
            # Gradient of 4 lambda_i lambda_j at the middle of side ab, where lambda_a = lambda_b = 1/2.
            grad = 2.0 * ((j in (a, b)) * slopes[:, i] + (i in (a, b)) * slopes[:, j])
            kappa = kappa + dyad(grad, tangent[:, k])[:, :, None] * delta[:, k, None, :]
        points.append(kappa)
    return torch.stack(points, dim=1), _shear_strains(corners, area, length[..., None] * side_shear)


def barycentric_gradients(corners: Float[Tensor, "m 3 2"], area: Float[Tensor, " m"]) -> Float[Tensor, "m 3 2"]:
    """Gradients of the barycentric coordinates lambda_1, lambda_2, lambda_3 [1/m]."""
    opposite = corners.roll(-2, dims=1) - corners.roll(-1, dims=1)
    return torch.stack([-opposite[..., 1], opposite[..., 0]], dim=-1) / (2.0 * area[:, None, None])


def _shear_strains(corners: Tensor, area: Tensor, along: Tensor) -> Float[Tensor, "m 3 2 9"]:
    """Shear strains at the middles of the sides, from gamma_k L_k of the sides [triangle, side, freedom]."""
    x = corners - corners.mean(1, keepdim=True)
    quarter = x.new_tensor([[0.0, -1.0], [1.0, 0.0]])
    opposite = x.roll(-2, dims=1) @ quarter.T  # of side k, turned: Whitney's field of it has this mean, over 2 area
    mean = torch.einsum("mkc,mkf->mcf", opposite, along) / (-2.0 * area[:, None, None])
    curl = along.sum(1) / area[:, None]
    J = x.mT @ x
    middles = 0.5 * (x + x.roll(-1, dims=1)) @ (J @ quarter).mT / J.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    return mean[:, None] + middles[..., None] * curl[:, None, None]


ALPHA_B = 1.5
HIGHER_SOFTNESS = 100.0

#: Felippa's beta_1 ... beta_9 of OPT, set out as Q_i (rows: sides 12, 23, 31; columns: corner rotations 1, 2, 3).
_BETA = (
    ((1.0, 2.0, 1.0), (0.0, 1.0, -1.0), (-1.0, -1.0, -2.0)),
    ((-2.0, -1.0, -1.0), (1.0, 1.0, 2.0), (-1.0, 0.0, 1.0)),
    ((1.0, -1.0, 0.0), (-1.0, -2.0, -1.0), (2.0, 1.0, 1.0)),
)


def beta0(poisson: float | Float[Tensor, " m"]) -> Float[Tensor, "*m"]:
    """Weight of the higher-order part that is optimal for an isotropic plate of this Poisson's ratio."""
    return (0.5 * (1.0 - 4.0 * torch.as_tensor(poisson, dtype=torch.float64) ** 2)).clamp_min(0.01)


def membrane_strains(
    corners: Float[Tensor, "m 3 2"],
    area: Float[Tensor, " m"],
    poisson: float | Float[Tensor, " m"],
    softness: Float[Tensor, " m"] | None = None,
    mixed: Bool[Tensor, "m 3"] | None = None,
) -> Float[Tensor, "m 3 3 9"]:
    """Return E [triangle, side middle, (eps_xx, eps_yy, gamma_xy), (u, v, theta_z) x 3 corners].

    mixed: sides with a cell of another kind, where alpha_b is 1 (sides.py); None: there are none
    """
    r = torch.zeros_like(area) if softness is None else softness
    alpha = torch.full_like(corners[..., 0], ALPHA_B)
    if mixed is not None:
        alpha = torch.where(mixed, 1.0, alpha)
    basic = mean_strain(corners, area, alpha / (1.0 + r)[:, None])
    rotation = _hierarchical_rotation(corners, area)
    weight = 1.5 * (beta0(poisson) / (1.0 + HIGHER_SOFTNESS * r)).sqrt()
    return basic[:, None] + weight[:, None, None, None] * (_hierarchical_strains(corners, area) @ rotation[:, None])


def _hierarchical_rotation(corners: Tensor, area: Tensor) -> Float[Tensor, "m 3 9"]:
    """Corner rotations less that of the linear field, theta_0 = (v_,x - u_,y) / 2."""
    x, y = corners.unbind(-1)
    T = corners.new_zeros(len(corners), 3, 9)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        T[:, :, 3 * i] = ((x[:, k] - x[:, j]) / (4.0 * area))[:, None]
        T[:, :, 3 * i + 1] = ((y[:, k] - y[:, j]) / (4.0 * area))[:, None]
        T[:, i, 3 * i + 2] = 1.0
    return T


def _hierarchical_strains(corners: Tensor, area: Tensor) -> Float[Tensor, "m 3 3 3"]:
    """T_e Q at the middles of the sides 12, 23, 31: cartesian strains from the corner rotations."""
    side = corners.roll(-1, dims=1) - corners
    l2 = (side**2).sum(-1)
    dx, dy = side.unbind(-1)
    natural = torch.stack([dx * dx, dy * dy, dx * dy], dim=-1) / l2[..., None]  # strain along each side
    beta = corners.new_tensor(_BETA)
    middles = 0.5 * (beta + beta.roll(-1, dims=0))
    Q = (2.0 / 3.0 * area[:, None] / l2)[:, None, :, None] * middles
    return torch.linalg.solve(natural[:, None], Q)


def triangle_strains(plane: Facets, mean: IsotropicMean) -> Strains:
    """Return the strains of every triangle at its three points."""
    mean = mean.of_cells(len(plane.area))
    softness = 2.0 * plane.area * (plane.tilt / mean.bending_length) ** 2
    membrane = membrane_strains(plane.corners, plane.area, mean.poisson, softness, plane.mixed)
    curvature, shear = plate_strains(plane.corners, plane.area, mean.shear_length, plane.side_area, plane.mixed)
    at = in_mesh_axes(plane.axes, membrane.unflatten(-1, (3, 3)), curvature, shear)
    return Strains(at, (plane.area / 3.0)[:, None].expand(-1, 3), at.mean(1))
