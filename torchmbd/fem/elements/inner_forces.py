"""Membrane forces that vary inside a cell and follow the laminate: the part of a stiffness that is not linear in it.

    N(x) = N_mean + sum_b c_b sigma_b(x),     eps - eps_mean = S (N - N_mean) - S B (kappa - kappa_mean),     S = A^-1

sigma_b   four states in equilibrium, without mean (quad_membrane.py), of any laminate; b of them are bending of fibers along
          the two medians, n the others
w_b       what these states work on the sides of the cell, and on what bending does to the mid-surface:
          w = W u + mean sigma' S B (kappa - kappa_mean)
U         mean sigma' S sigma
X         work of the states on sides that stretch linearly, in bending of unit amounts. The parabolas of bending are not in it
          and must not be attributed to the other states; so with the amounts c of bending, and the remaining work r,

              c = U_bb^-1 w_b,     r = w - X c,     r_n' = r_n - U_nb U_bb^-1 r_b
              energy / area = 1/2 w_b' U_bb^-1 w_b + 1/2 r_n' (U_nn - U_nb U_bb^-1 U_bn)^-1 r_n'

So the mid-surface of a cell deforms under bending and forces as the stack does, without degrees of freedom beside those of
corners. Since the variation of kappa meets D - B S B instead of D, a cell's stiffness is its linear part (plate.py) and

    K = J' C(A, B) J,     J: W and kappa - kappa_mean   [13, freedoms]

C is quadratic in w less B S B. Whatever varies is given by its amounts of three functions over the cell, without mean and
orthonormal in the mean. Exact derivatives come through the inverses of 3 x 3 and 2 x 2 matrices.
Source: T. H. H. Pian and P. Tong, Int. J. Numer. Methods Eng. 1 (1969) 3-28 (assumed stresses); quad_membrane.py.
Checked in tests/fem/elements/test_inner_forces.py, tests/contracts/test_shell_elements.py,
tests/validation/test_laminated_strips.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class InnerForces(NamedTuple):
    """Data of the inner forces of each cell that do not depend on the laminate; degrees of freedom as in strains.py.

    area        of the cell [m2]
    states      sigma: amounts of the three functions, components, bending first [m, 3, 3, 4]
    work        W [m, 4, freedoms]
    sides       X of unit compliances, in the order of `SYMMETRIC` [6, m, 4, 2]
    curvature   kappa - kappa_mean: amounts of the three functions, components [m, 3, 3, freedoms]
    """

    area: Float[Tensor, " m"]
    states: Float[Tensor, "m 3 3 4"]
    work: Float[Tensor, "m 4 f"]
    sides: Float[Tensor, "6 m 4 2"]
    curvature: Float[Tensor, "m 3 3 f"]


#: Rows and columns of the upper triangle of a symmetric 3 x 3 law.
SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def unit_laws() -> Float[Tensor, "6 3 3"]:
    """Symmetric matrices with one number 1, in the order of `SYMMETRIC`: S = sum_k S_k unit_k."""
    unit = torch.zeros(6, 3, 3, dtype=torch.float64)
    for k, (i, j) in enumerate(SYMMETRIC):
        unit[k, i, j] = unit[k, j, i] = 1.0
    return unit


def zero_mean_functions(weight: Float[Tensor, "m 4"]) -> Float[Tensor, "m 3 4"]:
    """Return the map from values at four points of these areas to amounts of three orthonormal functions of zero mean.

    It follows from the reflection that maps the roots of the points' shares of the area to the first axis.
    """
    root = (weight / weight.sum(1, keepdim=True)).sqrt()
    mirror = root + torch.eye(4, dtype=root.dtype)[0]
    mirror = mirror / mirror.norm(dim=1, keepdim=True)
    reflection = torch.eye(4, dtype=root.dtype) - 2.0 * mirror[:, :, None] * mirror[:, None]
    return reflection[:, 1:] * root[:, None]


class CellForces:
    """The inner forces of all cells of a kind as functions of the laminate."""

    def __init__(self, forces: InnerForces) -> None:
        self.inner_forces = forces
        self.rows = torch.cat([forces.work, forces.curvature.flatten(1, 2)], dim=1)  # J
        sigma = forces.states
        self._flexibility = torch.einsum("mesa,kst,metb->mkab", sigma, unit_laws(), sigma).flatten(2)
        self._sides = forces.sides.transpose(0, 1).flatten(2)
        self._states = sigma.permute(0, 3, 1, 2).flatten(1, 2)  # [m, state and function, component]

    def law(
        self, A: Float[Tensor, "*lanes c 3 3"], B: Float[Tensor, "*lanes c 3 3"]
    ) -> Float[Tensor, "*lanes m 13 13"]:
        """Return C of every cell, energy per area by the work of the states on the sides and by curvatures; c is m or 1."""
        strains, forces, _ = self._parts(A, B)
        S = torch.linalg.inv(A)
        relief = torch.einsum("ef,...st->...esft", torch.eye(3, dtype=A.dtype), B @ S @ B).flatten(-2).flatten(-3, -2)
        return strains.mT @ forces - torch.nn.functional.pad(relief, (4, 0, 4, 0))

    def amounts(
        self, A: Float[Tensor, "*lanes c 3 3"], B: Float[Tensor, "*lanes c 3 3"]
    ) -> Float[Tensor, "*lanes m 4 13"]:
        """Return the amounts of the states, by their work on the sides and by curvatures."""
        _, forces, lean = self._parts(A, B)
        bent, others = forces[..., :2, :], forces[..., 2:, :]
        return torch.cat([bent - lean.mT @ others, others], dim=-2)

    def at_points(self, weight: Float[Tensor, "m 4"]) -> Float[Tensor, "m 4 3 4"]:
        """Return the membrane forces of the states at the four points of these areas."""
        share = weight / weight.sum(1, keepdim=True)
        return torch.einsum("mep,mesb->mpsb", zero_mean_functions(weight) / share[:, None], self.inner_forces.states)

    def _parts(self, A: Tensor, B: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rows [4, 13] of strains and forces, and U_nb U_bb^-1; see the module header."""
        S = torch.linalg.inv(A)
        numbers = S.flatten(-2)[..., None, [3 * i + j for i, j in SYMMETRIC]]
        U = (numbers @ self._flexibility).unflatten(-1, (4, 4)).squeeze(-3)
        X = (numbers @ self._sides).unflatten(-1, (4, 2)).squeeze(-3)
        bent = (self._states @ (S @ B)).unflatten(-2, (4, 3)).flatten(-2)
        w = torch.cat([torch.eye(4, dtype=A.dtype).expand(*bent.shape[:-1], 4), bent], dim=-1)
        F, coupling = _inverse(U[..., :2, :2]), U[..., 2:, :2]
        lean = coupling @ F
        c = F @ w[..., :2, :]
        r = w - X @ c
        remainder = r[..., 2:, :] - lean @ r[..., :2, :]
        stiff = _inverse(U[..., 2:, 2:] - lean @ coupling.mT)
        return torch.cat([w[..., :2, :], remainder], dim=-2), torch.cat([c, stiff @ remainder], dim=-2), lean

    def stiffness(self, C: Float[Tensor, "lanes m 13 13"]) -> Float[Tensor, "lanes m f f"]:
        """Return area J' C J of all cells."""
        return (self.inner_forces.area[:, None, None] * self.rows).mT @ (C @ self.rows)

    def adjoint(self, K: Float[Tensor, "lanes m f f"]) -> Float[Tensor, "lanes m 13 13"]:
        """Return the adjoint of `stiffness`: the cotangent of C from that of K."""
        return (self.inner_forces.area[:, None, None] * self.rows) @ K @ self.rows.mT


def _inverse(X: Float[Tensor, "*any 2 2"]) -> Float[Tensor, "*any 2 2"]:
    """Return the inverses of symmetric matrices."""
    a, b, d = X.flatten(-2)[..., [0, 1, 3]].unbind(-1)
    return torch.stack([d, -b, -b, a], dim=-1).unflatten(-1, (2, 2)) / (a * d - b * b)[..., None, None]
