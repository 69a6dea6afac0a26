"""Inertia invariants: the sums over all nodes in the equations of motion of a body, computed once per design.

Node k sits at x_k in the body frame and moves by the modes: displacement t_k w, small rotation r_k w. Where masses lie
off the nodes of the mesh, at middles of sides or on rigid arms, "node" means such a mass point (fem/elements/assembly.py).
Its lumped mass is m_k, its rotary inertia mu_k times the 3 x 3 identity (eq. 2). All nodal sums in the
mass matrix and the inertia forces (eqs. 1-3) are polynomials of degree two in w and in the orientation;
their coefficients are

    mass  = sum m              S0_i  = sum m x_i           S1_ia  = sum m t_ia
    mu    = sum mu             P0_ij = sum m x_i x_j       C0_ija = sum m t_ia x_j
    R1_ia = sum mu r_ia        R2_ijab = sum mu r_ia r_jb  C1_ijab = sum m t_ia t_jb

i, j     axes of the body frame                            a, b     modes
x        position of the nodes                       [m]
m, mu    lumped mass and rotary inertia of the nodes [kg], [kg m^2]
psi      rows of the modes at the nodes: three displacements, three rotations

Leading lanes `...` throughout. Differentiable, forward and reverse, in all arguments.
Assumed: lumped masses, rotary inertia isotropic at each node, rotations of the modes small.
Source: eqs. (1)-(3) of the paper, expanded.
Checked in tests/fem/reduction/test_invariants.py against direct nodal sums.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError


def inertia_invariants(
    x: Float[Tensor, "*lanes nodes 3"],
    mass: Float[Tensor, "*lanes nodes"],
    rotary: Float[Tensor, "*lanes nodes"],
    psi: Float[Tensor, "*lanes nodes 6 modes"],
) -> dict[str, Tensor]:
    """Sum over the nodes; keys and shapes as in the module header, with leading lanes. Raises InputError on shapes."""
    return all_invariants(x, mass, rotary, modal_invariants(x, mass, rotary, psi))


def modal_invariants(x: Tensor, mass: Tensor, rotary: Tensor, psi: Tensor) -> tuple[Tensor, ...]:
    """The invariants that depend on the modes: S1, C0, C1, R1, R2; arguments as in `inertia_invariants`."""
    nodes = x.shape[-2]
    if mass.shape[-1] != nodes or rotary.shape[-1] != nodes or psi.shape[-3:-1] != (nodes, 6):
        shapes = ", ".join(str(tuple(a.shape)) for a in (x, mass, rotary, psi))
        raise InputError(
            "x",
            allowed="must have shapes [..., n, 3], [..., n], [..., n], [..., n, 6, m]",
            state=f"have shapes {shapes}",
            noun="x, mass, rotary, psi",
        )
    t, r = psi[..., :3, :], psi[..., 3:, :]
    return (
        torch.einsum("...k,...kia->...ia", mass, t),
        torch.einsum("...kj,...kia->...ija", mass[..., None] * x, t),
        _pairs(t, mass),
        torch.einsum("...k,...kia->...ia", rotary, r),
        _pairs(r, rotary),
    )


def all_invariants(x: Tensor, mass: Tensor, rotary: Tensor, modal: Sequence[Tensor]) -> dict[str, Tensor]:
    """All invariants, of which the `modal_invariants` are known."""
    S1, C0, C1, R1, R2 = modal
    weighted = mass[..., None] * x
    return {
        "mass": mass.sum(-1),
        "S0": weighted.sum(-2),
        "S1": S1,
        "P0": weighted.mT @ x,
        "C0": C0,
        "C1": C1,
        "mu": rotary.sum(-1),
        "R1": R1,
        "R2": R2,
    }


def _pairs(rows: Tensor, weight: Tensor) -> Tensor:
    """sum_k weight_k rows_kia rows_kjb -> [..., i, j, a, b], as one matrix product over the nodes."""
    modes = rows.shape[-1]
    flat = rows.flatten(-2)
    square = (flat * weight[..., None]).mT @ flat
    return square.unflatten(-1, (3, modes)).unflatten(-3, (3, modes)).transpose(-3, -2)
