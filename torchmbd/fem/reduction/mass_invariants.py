"""Inertia invariants of a given mass matrix, consistent or lumped.

The sums of invariants.py are integrals over the body. Of a mass matrix M [6 n, 6 n] over displacements and rotations of
all nodes they are products with nodal values of fields that are constant or linear in x,

    T_i     displacement e_i                                      X_ij    displacement e_i x_j, rotation 1/2 curl of it
    R_k     rotation about axis k through the origin = sum_ij eps_ikj X_ij

    mass   = T_i' M T_i               S1_ia  = T_i' M psi_a          total inertia J = R' M R = tr(P0) 1 - P0
    S0     from T' M R = -skew(S0)    C0_ija = X_ij' M psi_a         C1_ijab = sum over mass of u_ia u_jb

u_ia is the displacement of mass in mode a. M tells between nodes k and l a mass m (mean over the axes), a first
moment s and second moments P of masses on arms that turn with the nodes:

    M_kl = [ m 1                     M_tr,  s_q = 1/2 eps_ipq M_tr,ip                       ]      u = t + r x arm
           [ symmetric               J,     P_qv = 1/2 tr(J) 1 - J_vq                       ]

Where all rotary inertias are isotropic without first moments (lumped plates), they have no arms: R2_ijab = sum mu r_ia r_jb.
What is left of psi' M psi is put into R2, in equal parts for the axes. mu and R1 are zero: J and C0 hold what they would tell.

Exact for every M: mass, center, inertia, momentum and angular momentum linear in the modes, modal mass. Exact also in
terms of second order (inertia of the deformed body, centrifugal and Coriolis forces among modes): solids of three
degrees of freedom a node, lumped masses on arms, Hermite beams. Assumed there: the mass between two nodes is the same along
the three axes.
Differentiable, forward and reverse, in the values of M and in psi, with lanes.
Checked in tests/fem/reduction/test_mass_invariants.py, tests/multibody/bodies/test_from_matrices.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.math.sparse import SparseMatrix

ISOTROPY = 1e-9  # relative difference of rotary inertias that count as equal


def epsilon() -> Float[Tensor, "3 3 3"]:
    """The permutation symbol."""
    result = torch.zeros(3, 3, 3, dtype=torch.float64)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[i, j, k], result[i, k, j] = 1.0, -1.0
    return result


def linear_fields(x: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "6n 3"], Float[Tensor, "6n 3 3"]]:
    """Nodal values of the fields T_i and X_ij of the module header at nodes x [n, 3]."""
    n = len(x)
    T, X = x.new_zeros(n, 6, 3), x.new_zeros(n, 6, 3, 3)
    T[:, :3] = torch.eye(3, dtype=x.dtype)
    X[:, :3] = torch.einsum("li,kj->klij", torch.eye(3, dtype=x.dtype), x)
    X[:, 3:] = 0.5 * epsilon().permute(2, 1, 0)  # curl(e_i x_j) = e_j x e_i
    return T.flatten(0, 1), X.flatten(0, 1)


def rigid_motions(x: Float[Tensor, "n 3"]) -> Float[Tensor, "6n 6"]:
    """Nodal values of three translations and three rotations about the origin."""
    T, X = linear_fields(x)
    return torch.cat([T, torch.einsum("ikj,nij->nk", epsilon(), X)], dim=1)


def has_isotropic_inertia(M: SparseMatrix) -> bool:
    """True if all rotary inertias of M are the same about all axes and M has no first moments: its masses need no arms."""
    i, j = M.pattern.rows % 6, M.pattern.cols % 6
    values = M.values.detach().reshape(-1, M.pattern.nnz).abs()
    rotary = values * ((i >= 3) & (j >= 3))
    bound = ISOTROPY * rotary.amax()
    off = rotary * (i != j)
    mixed = values * ((i >= 3) != (j >= 3))
    blocks = M.pattern.rows // 6 * (M.size // 6) + M.pattern.cols // 6
    _, block = torch.unique(blocks, return_inverse=True)
    each = values.new_zeros(3, len(values), int(block.max()) + 1)
    for k in range(3):
        mask = (i == 3 + k) & (j == 3 + k)
        each[k].index_add_(1, block[mask], M.values.detach().reshape(-1, M.pattern.nnz)[:, mask])
    spread = (each.amax(0) - each.amin(0)).amax()
    length = (M.values.detach().abs().amax() * rotary.amax()).sqrt()
    return bool((off.amax() <= bound) & (spread <= bound) & (mixed.amax() <= ISOTROPY * length))


def mass_invariants(
    x: Float[Tensor, "n 3"], M: SparseMatrix, psi: Float[Tensor, "*lanes n 6 m"], arms: bool = True
) -> dict[str, Tensor]:
    """Invariants of the module header, with the keys and shapes of invariants.py.

    x     nodes from the origin of the body frame [m]
    M     of all degrees of freedom 6 * node + i, symmetric; degrees of freedom that do not exist have no entries
    psi   modes at the nodes: three displacements, three rotations
    arms  whether rotary inertia is that of masses on arms; False where `has_isotropic_inertia`
    """
    columns = psi.flatten(-3, -2)
    T, X = linear_fields(x)
    eps, eye = epsilon(), torch.eye(3, dtype=x.dtype)
    R = torch.einsum("ikj,nij->nk", eps, X)
    MT, MR, moved = M @ T, M @ R, M @ columns
    mass = torch.einsum("ni,...ni->...", T, MT) / 3.0
    S0 = 0.5 * torch.einsum("ikj,ni,...nk->...j", eps, T, MR)
    J = R.mT @ MR
    P0 = 0.5 * J.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * eye - J
    C1 = _pairs(M, psi, 0)
    R2 = torch.zeros_like(C1) if arms else _pairs(M, psi, 3)
    C0 = (X.flatten(1).mT @ moved).unflatten(-2, (3, 3))
    if arms:
        on_arms = _first_moments(M, psi)
        C0, C1 = C0 + 0.5 * (on_arms + on_arms.transpose(-3, -2)), C1 + _second_moments(M, psi)
    rest = columns.mT @ moved - torch.einsum("...iiab->...ab", C1 + R2)
    S1 = T.mT @ moved
    return {
        "mass": mass,
        "S0": S0,
        "S1": S1,
        "P0": P0,
        "C0": C0,
        "C1": C1,
        "mu": torch.zeros_like(mass),
        "R1": torch.zeros_like(S1),
        "R2": R2 + eye[:, :, None, None] * (rest[..., None, None, :, :] / 3.0),
    }


def _first_moments(M: SparseMatrix, psi: Tensor) -> Tensor:
    """sum over mass of u_ia arm_j [..., i, j, a]: the part of C0 by the arms, as mass is at node + arm."""
    nodes, eps = psi.shape[-3], epsilon()
    turned = torch.zeros(nodes, 6, 3, dtype=psi.dtype)
    turned[:, 3:] = torch.eye(3, dtype=psi.dtype)
    products = (M @ turned.flatten(0, 1)).unflatten(-2, (nodes, 6))
    t, r = psi[..., :3, :], psi[..., 3:, :]
    s = 0.5 * torch.einsum("ipq,...nip->...nq", eps, products[..., :3, :])
    J = products[..., 3:, :]
    P = 0.5 * J.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * torch.eye(3, dtype=psi.dtype) - J.mT
    return torch.einsum("...nia,...nj->...ija", t, s) + torch.einsum("ipq,...npa,...nqj->...ija", eps, r, P)


def _second_moments(M: SparseMatrix, psi: Tensor) -> Tensor:
    """sum over mass of u_ia u_jb [..., i, j, a, b] without that of translations alone."""
    nodes, modes, eps = psi.shape[-3], psi.shape[-1], epsilon()
    t, r = psi[..., :3, :], psi[..., 3:, :].flatten(-2)  # [..., n, 3 m]
    products = []
    for w in range(3):
        column = psi.new_zeros(*psi.shape[:-3], nodes, 6, 3 * modes)
        column[..., 3 + w, :] = r
        products.append((M @ column.flatten(-3, -2)).unflatten(-2, (nodes, 6)).unflatten(-1, (3, modes)))
    Y = torch.stack(products, -5)  # [..., w, n, 6, u, b]
    s = 0.5 * torch.einsum("mwv,...wnmub->...nvub", eps, Y[..., :3, :, :])
    cross = torch.einsum("juv,...nia,...nvub->...ijab", eps, t, s)
    J = Y[..., 3:, :, :]
    trace = 0.5 * torch.einsum("...wnwub->...nub", J)
    r = psi[..., 3:, :]
    both = torch.einsum("ipq,juq,...npa,...nub->...ijab", eps, eps, r, trace)
    both = both - torch.einsum("ipq,juv,...npa,...qnvub->...ijab", eps, eps, r, J)
    return cross + cross.transpose(-4, -3).transpose(-2, -1) + both


def _pairs(M: SparseMatrix, psi: Tensor, first: int) -> Tensor:
    """sum_kl m_kl t_kia t_ljb [..., i, j, a, b] of the rows of psi from `first` on; m the mean over their axes."""
    t = psi[..., first : first + 3, :].flatten(-2)  # [..., n, 3 m]
    rows = 6 * torch.arange(psi.shape[-3]) + first
    moved = torch.stack([M.restrict(rows + i) @ t for i in range(3)]).mean(0)
    modes = psi.shape[-1]
    return (t.mT @ moved).unflatten(-1, (3, modes)).unflatten(-3, (3, modes)).transpose(-3, -2)
