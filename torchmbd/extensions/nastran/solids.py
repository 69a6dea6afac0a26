"""Solids: tetrahedra of 4 or 10 nodes, wedges of 6 or 15, bricks of 8 or 20; those of more have nodes on their sides.

    K_e = int B' D B dV      D [6, 6] over strains xx, yy, zz, xy, yz, zx (engineering shear); three displacements at each node

Bricks have three incompatible modes 1 - r_i^2, whose derivatives are taken with the Jacobian of the middle, condensed: a brick
bends without locking in shear, and the patch test holds. Tetrahedra and wedges of this kind are stiff in bending.
Those with nodes on sides are serendipity elements: quadratic, isoparametric. Mass at node k: int N_k dV rho of linear solids;
of the others in the ratio of int N_k^2 dV (E. Hinton, T. Rock, O. C. Zienkiewicz, 1976), as int N_k is negative at corners.
Source: E. L. Wilson, R. L. Taylor et al., Incompatible displacement models, 1973; R. L. Taylor, P. J. Beresford, E. L.
Wilson, IJNME 10 (1976) 1211-1219.
Checked in tests/extensions/nastran/test_solids.py.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.shape_functions import serendipity_powers, shape_functions, simplex_powers

_G = 1.0 / math.sqrt(3.0)
_BRICK = torch.tensor(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
    dtype=torch.float64,
)
CORNERS = (4, 6, 8)
_SIDES = {
    10: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
    15: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3)),
    20: (*((0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 5)), *((2, 6), (3, 7), (4, 5), (5, 6), (6, 7), (7, 4))),
}


def _numbers(x: list) -> Tensor:
    return torch.tensor(x, dtype=torch.float64)


def _shapes(nodes: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Values [g, k] and derivatives [g, k, 3] of shape functions at Gauss points, their weights [g], and the points [g, 3]."""
    degree = 1 if nodes in CORNERS else 2
    line = [(-_G, 1.0), (_G, 1.0)] if degree == 1 else [(-math.sqrt(0.6), 5 / 9), (0.0, 8 / 9), (math.sqrt(0.6), 5 / 9)]
    flat = simplex_powers(degree)
    if nodes in (4, 10):
        corners = _numbers([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        a, b = (5.0 + 3.0 * math.sqrt(5.0)) / 20.0, (5.0 - math.sqrt(5.0)) / 20.0
        points = _numbers([[0.25] * 3]) if degree == 1 else b + (a - b) * corners
        weights = _numbers([1.0 / 6.0 / len(points)] * len(points))
        powers = [(i, j, k) for i, j in flat for k in range(degree + 1 - i - j)]
    elif nodes in (6, 15):
        corners = _numbers([[x, y, t] for t in (-1.0, 1.0) for x, y in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))])
        places = [(1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3)]
        points = _numbers([[x, y, t] for x, y in places for t, _ in line])
        weights = _numbers([w / 6 for _, w in line] * 3)
        powers = [(i, j, k) for i, j in flat for k in range(degree + 1) if k < 2 or i + j <= 1]
    else:
        corners = _BRICK
        points = _numbers([[x, y, z] for x, _ in line for y, _ in line for z, _ in line])
        weights = _numbers([u * v * w for _, u in line for _, v in line for _, w in line])
        powers = serendipity_powers(degree, 3)
    middles = [(corners[i] + corners[j]) / 2.0 for i, j in _SIDES.get(nodes, ())]
    N, slopes = shape_functions(torch.stack([*corners, *middles]), powers, points)
    return N, slopes, weights, points


def _strains(slopes: Float[Tensor, "... k 3"]) -> Float[Tensor, "... 6 k3"]:
    """B of derivatives along x, y, z."""
    B = slopes.new_zeros(*slopes.shape[:-2], 6, slopes.shape[-2], 3)
    for row, pairs in enumerate([[(0, 0)], [(1, 1)], [(2, 2)], [(0, 1), (1, 0)], [(1, 2), (2, 1)], [(2, 0), (0, 2)]]):
        for component, along in pairs:
            B[..., row, :, component] = slopes[..., along]
    return B.flatten(-2)


def solid_matrices(
    x: Float[Tensor, "m k 3"], D: Float[Tensor, "6 6"]
) -> tuple[Float[Tensor, "m k3 k3"], Float[Tensor, "m k"], Float[Tensor, "m g"]]:
    """Stiffness [N/m], volumes that belong to the nodes [m3], and volumes at Gauss points, all positive in a right element."""
    nodes = x.shape[1]
    N, slopes, weights, points = _shapes(nodes)
    J = torch.einsum("gkr,mki->mgri", slopes, x)
    volume = torch.linalg.det(J) * weights
    singular = volume.abs() < 1e-300
    inverse = torch.linalg.inv(torch.where(singular[..., None, None], torch.eye(3, dtype=x.dtype), J))
    B = _strains(torch.einsum("mgir,gkr->mgki", inverse, slopes))
    K = torch.einsum("mg,mgsa,st,mgtb->mab", volume, B, D, B)
    if x.shape[1] == 8:
        K = K - _incompatible(x, D, B, volume, slopes, points)
    share = torch.einsum("mg,gk->mk", volume, N if nodes in CORNERS else N**2)
    return 0.5 * (K + K.mT), share * (volume.sum(1) / share.sum(1))[:, None], volume


def _incompatible(x: Tensor, D: Tensor, B: Tensor, volume: Tensor, slopes: Tensor, points: Tensor) -> Tensor:
    """What the condensed incompatible modes take from K."""
    J = torch.einsum("kr,mki->mri", _BRICK / 8.0, x)  # at the middle
    size = torch.linalg.det(J)
    safe = torch.where((size.abs() < 1e-300)[:, None, None], torch.eye(3, dtype=x.dtype), J)
    local = -2.0 * torch.diag_embed(points)  # of 1 - r_i^2: [g, mode, r]
    along = torch.einsum("mir,gkr->mgki", torch.linalg.inv(safe), local) * (size[:, None] / volume)[..., None, None]
    A = _strains(along)
    E = torch.einsum("mg,mgsa,st,mgtb->mab", volume, A, D, A)
    L = torch.einsum("mg,mgsa,st,mgtb->mab", volume, A, D, B)
    regular = torch.where((volume <= 0).any(1)[:, None, None], torch.eye(9, dtype=x.dtype), E)
    return L.mT @ torch.linalg.solve(regular, L)
