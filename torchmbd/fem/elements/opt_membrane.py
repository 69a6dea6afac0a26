"""Strains of the optimal membrane triangle with corner drilling freedoms (OPT).

Freedoms of a corner: u, v, theta_z (a real in-plane rotation, no penalty). The strain is

    eps(zeta) = (1 / area) L' u  +  3/2 sqrt(beta0) T_e Q(zeta) (theta - theta_0)

basic part   L lumps a constant stress to corner forces (sides.py), alpha_b = 3/2: any patch test passes
higher part  natural strains along the sides, linear in zeta and without mean, driven by the corner rotations less
             the rotation theta_0 of the linear displacement field
beta0        weight of the higher part; 1/2 (1 - 4 nu^2) makes in-plane bending of rectangular cells exact

softness     r >= 0 of curved shells (strains.py): alpha_b / (1 + r) and beta0 / (1 + 100 r). Both are free numbers of
             the template, so patch tests, rigid motions and the rank do not notice; 100 is a compromise of the
             hemisphere, the twisted beam and the roof in tests/validation/test_curved_shells.py

Sampled at the middles of the sides 12, 23, 31, where the three-point rule integrates the energy exactly. So the
stiffness sum_points area/3 E' A E is linear in the membrane stiffness A, and the same strains couple with bending.
Assumed: homogeneous facet, small strains. Rank 6, exact rigid-body motion.
Source: C. A. Felippa, A study of optimal membrane triangles with drilling freedoms, Comput. Methods Appl. Mech. Engrg.
192 (2003) 2125-2168, doi:10.1016/S0045-7825(03)00253-6, sections 3-5 and Table 1 (OPT).
Checked in tests/fem/elements/test_opt_membrane.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmbd.fem.elements.sides import mean_strain

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
