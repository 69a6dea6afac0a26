"""Transverse shear stresses through the thickness of a laminate, and the shear stiffness of the same energy.

    tau(z) = F(z) Q         stresses (tau_xz, tau_yz) of the shear forces (Q_x, Q_y)
    As^-1  = integral of F' Gbar^-1 F dz

F follows from equilibrium in the plane, tau_xz,z = -(sig_xx,x + sig_xy,y) and so on, in two states of cylindrical
bending: M_xx,x = Q_x and M_yy,y = Q_y, all other derivatives of forces and moments zero. So F vanishes at both faces
and its integral is the unit matrix, for any stack: unbalanced, unsymmetric, sandwich. A homogeneous plate gets the
parabola and As = 5/6 G h.

The two states are taken along the axes of the laminate. So As is not an exact tensor: a general stack whose axes are turned
one way and its plies the other differs by up to a sixth of As; axes along the direction of bending are the best choice.

Differentiable, forward and reverse, in angles and thicknesses, with lanes `...`.
Source: R. Rolfes and K. Rohwer, Improved transverse shear stresses in composite finite elements based on first order
shear deformation theory, Int. J. Numer. Methods Eng. 40 (1997) 51-60; P. Vlachoutsis, Shear correction factors for
plates and shells, Int. J. Numer. Methods Eng. 33 (1992) 1537-1552, is its case without coupling of directions.
Checked in tests/fem/materials/test_transverse_shear.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

#: Points (from 0, the bottom of a layer, to 1) and weights that integrate the fourth-order energy exactly.
_GAUSS = ((0.5 - math.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + math.sqrt(0.15), 5 / 18))


@dataclass(frozen=True, eq=False)
class ShearShape:
    """F(z) of every layer: bottom - constant (z - z_bottom) - linear (z^2 - z_bottom^2) / 2, all [..., layers, 2, 2]."""

    bottom: Float[Tensor, "*lanes layers 2 2"]
    constant: Float[Tensor, "*lanes layers 2 2"]
    linear: Float[Tensor, "*lanes layers 2 2"]
    faces: Float[Tensor, "*lanes layers 2"]

    def at(self, share: float | Tensor) -> Float[Tensor, "*lanes layers 2 2"]:
        """F [1/m] in every layer at a share of its thickness: 0 its bottom, 1 its top."""
        start, end = self.faces.unbind(-1)
        return self.bottom + _growth(self.constant, self.linear, start, start + share * (end - start))


def shear_shape(
    Qbar: Float[Tensor, "*lanes layers 3 3"],
    faces: Float[Tensor, "*lanes layers 2"],
    A: Float[Tensor, "*lanes 3 3"],
    B: Float[Tensor, "*lanes 3 3"],
    D: Float[Tensor, "*lanes 3 3"],
) -> ShearShape:
    """Return F of a laminate: ply stiffness in plate axes, heights of bottom and top of each layer, and its A, B, D."""
    A, B, D = (x.unsqueeze(-3) for x in (A, B, D))  # single matrices have products of other rounding than batches
    compliance = torch.linalg.inv(A) @ B  # not solve: its tangents in a batch of torch.func.vmap are wrong (torch 2.13)
    curvature = torch.linalg.inv(D - B @ compliance)[..., :2]  # columns: of M_xx,x and of M_yy,y
    strain = -compliance @ curvature
    constant, linear = _gradients(Qbar.unsqueeze(-4) @ torch.stack([strain, curvature], -4)).unbind(-4)
    start, end = faces.unbind(-1)
    top = _growth(constant, linear, start, end).cumsum(-3)
    bottom = torch.cat([torch.zeros_like(top[..., :1, :, :]), top[..., :-1, :, :]], dim=-3)
    return ShearShape(bottom, constant, linear, faces)


def energy_shear_stiffness(shape: ShearShape, Gbar: Float[Tensor, "*lanes layers 2 2"]) -> Float[Tensor, "*lanes 2 2"]:
    """Return As [N/m] of the same energy; Gbar: transverse shear stiffness of the plies in plate axes."""
    thickness = shape.faces[..., 1] - shape.faces[..., 0]
    share, weight = Gbar.new_tensor(_GAUSS).T[..., None]
    bottom, constant, linear = (x.unsqueeze(-4) for x in (shape.bottom, shape.constant, shape.linear))
    F = ShearShape(bottom, constant, linear, shape.faces.unsqueeze(-3)).at(share)
    energy = (weight * thickness.unsqueeze(-2))[..., None, None] * (F.mT @ inverse2(Gbar).unsqueeze(-4) @ F)
    return inverse2(energy.sum((-4, -3)))


def _growth(constant: Tensor, linear: Tensor, start: Tensor, end: Tensor) -> Tensor:
    return -(constant * (end - start)[..., None, None] + linear * (0.5 * (end**2 - start**2))[..., None, None])


def _gradients(stress: Tensor) -> Tensor:
    """Return -tau_xz,z and -tau_yz,z from stresses [..., (xx, yy, xy), (state that varies with x, with y)]."""
    return stress.flatten(-2)[..., [0, 5, 4, 3]].unflatten(-1, (2, 2))  # xx of the first, xy of the second; xy, yy


def inverse2(X: Float[Tensor, "*lanes 2 2"]) -> Float[Tensor, "*lanes 2 2"]:
    """Invert 2 x 2 matrices by plain arithmetic: there are many."""
    a, b, c, d = X.flatten(-2).unbind(-1)
    return torch.stack([d, -b, -c, a], dim=-1).unflatten(-1, (2, 2)) / (a * d - b * c)[..., None, None]
