"""Inertia invariants from a mass matrix from outside, consistent or lumped.

The sums of invariants.py are integrals over the body. Of a mass matrix M [6 n, 6 n] over displacements and rotations of
all nodes they are products with nodal values of fields that are constant or linear in x,

    T_i     displacement e_i                                      X_ij    displacement e_i x_j, rotation 1/2 curl of it
    R_k     rotation about axis k through the origin = sum_ij eps_ikj X_ij

    mass   = T_i' M T_i               S1_ia  = T_i' M psi_a          total inertia J = R' M R = tr(P0) 1 - P0
    S0     from T' M R = -skew(S0)    C0_ija = X_ij' M psi_a         C1_ijab = sum_kl m_kl t_kia t_ljb

                                                                    R2_ijab = sum_kl mu_kl r_kia r_ljb + rest

m_kl and mu_kl are means over the three axes of the entries of M for translations and rotations of nodes k and l. What is
left of psi' M psi is put into R2, in equal parts for the axes. mu and R1 are zero: J and C0 hold what they would tell.

Exact for every M: mass, center, inertia, momentum and angular momentum linear in the modes, modal mass, the centrifugal
force on the undeformed body. Assumed in the terms of second order in the modal coordinates (inertia of the
deformed body, Coriolis forces among modes): the mass between two nodes is the same along the three axes, the rotary
inertia about them too, and neither couples translations with rotations. This holds for solids of three freedoms a node
and for masses and isotropic inertias lumped at nodes.
Differentiable, forward and reverse, in the values of M and in psi, with lanes.
Checked in tests/fem/reduction/test_mass_invariants.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.math.sparse import SparseMatrix


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


def mass_invariants(
    x: Float[Tensor, "n 3"], M: SparseMatrix, psi: Float[Tensor, "*lanes n 6 m"]
) -> dict[str, Tensor]:
    """Invariants of the module header, with the keys and shapes of invariants.py.

    x     nodes from the origin of the body frame [m]
    M     of all freedoms 6 * node + i, symmetric; freedoms that do not exist have no entries
    psi   modes at the nodes: three displacements, three rotations
    """
    columns = psi.flatten(-3, -2)
    T, X = linear_fields(x)
    eps = epsilon()
    R = torch.einsum("ikj,nij->nk", eps, X)
    MT, MR, moved = M @ T, M @ R, M @ columns
    mass = torch.einsum("ni,...ni->...", T, MT) / 3.0
    S0 = 0.5 * torch.einsum("ikj,ni,...nk->...j", eps, T, MR)
    J = R.mT @ MR
    P0 = 0.5 * J.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * torch.eye(3, dtype=x.dtype) - J
    C1, R2 = (_pairs(M, psi, first) for first in (0, 3))
    rest = columns.mT @ moved - torch.einsum("...iiab->...ab", C1 + R2)
    S1 = T.mT @ moved
    return {
        "mass": mass,
        "S0": S0,
        "S1": S1,
        "P0": P0,
        "C0": (X.flatten(1).mT @ moved).unflatten(-2, (3, 3)),
        "C1": C1,
        "mu": torch.zeros_like(mass),
        "R1": torch.zeros_like(S1),
        "R2": R2 + torch.eye(3, dtype=x.dtype)[:, :, None, None] * (rest[..., None, None, :, :] / 3.0),
    }


def _pairs(M: SparseMatrix, psi: Tensor, first: int) -> Tensor:
    """sum_kl m_kl t_kia t_ljb [..., i, j, a, b] of the rows of psi from `first` on."""
    t = psi[..., first : first + 3, :].flatten(-2)  # [..., n, 3 m]
    rows = 6 * torch.arange(psi.shape[-3]) + first
    moved = torch.stack([M.restrict(rows + i) @ t for i in range(3)]).mean(0)
    modes = psi.shape[-1]
    return (t.mT @ moved).unflatten(-1, (3, modes)).unflatten(-3, (3, modes)).transpose(-3, -2)
