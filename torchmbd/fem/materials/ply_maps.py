"""Strains and stresses of every layer, at its bottom and its top, from the eight strains of the plate.

    (11, 22, 12, 13, 23) = map (eps_xx, eps_yy, gamma_xy, kappa_xx, kappa_yy, kappa_xy, gamma_xz, gamma_yz)

in plane        strain = T(theta) (eps + z kappa),  stress = Q strain
out of plane    stress = R(theta) F(z) As gamma: the stresses of the shear forces Q = As gamma by equilibrium
                (transverse_shear.py), zero at the faces, continuous between the layers

Ply axes: 1 = fiber, 3 = the plate's normal. Both maps depend on the design, and are linear in the plate strains.
Differentiable, forward and reverse, in angles and thicknesses, with lanes.
Source: R. M. Jones, Mechanics of Composite Materials, 2nd ed., section 4.2; Rolfes and Rohwer (1997).
Checked in tests/fem/materials/test_ply_maps.py.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.materials.laminate import Laminate, strain_rotations


class PlyMaps(NamedTuple):
    """Maps [..., layers, (bottom, top), (11, 22, 12, 13, 23), 8 plate strains]; the stress in Pa."""

    strain: Float[Tensor, "*lanes layers 2 5 8"]
    stress: Float[Tensor, "*lanes layers 2 5 8"]


def ply_maps(laminate: Laminate) -> PlyMaps:
    """Return the maps of one laminate, or of its lanes."""
    T, R = strain_rotations(laminate.layer_angles)
    Q, G = laminate.layer_stiffness
    z = laminate.faces[..., None, None]
    T = T.unsqueeze(-3)  # for both faces
    plane = torch.cat(torch.broadcast_tensors(T, z * T), dim=-1)
    shape, As = laminate.shear_shape(), laminate.stiffness().As[..., None, None, :, :]
    F = torch.stack([shape.at(0.0), shape.at(1.0)], dim=-3)
    shear = R.unsqueeze(-3) @ F @ As
    strain = _diagonal(plane, shear / G.diagonal(dim1=-2, dim2=-1)[..., None, :, None])
    return PlyMaps(strain, _diagonal(Q.unsqueeze(-3) @ plane, shear))


def _diagonal(plane: Tensor, shear: Tensor) -> Tensor:
    """Join a map of the first six strains to (11, 22, 12) and one of the last two to (13, 23)."""
    lanes = np.broadcast_shapes(plane.shape[:-2], shear.shape[:-2])
    plane, shear = plane.expand(*lanes, 3, 6), shear.expand(*lanes, 2, 2)
    upper = torch.cat([plane, plane.new_zeros(*lanes, 3, 2)], dim=-1)
    return torch.cat([upper, torch.cat([shear.new_zeros(*lanes, 2, 6), shear], dim=-1)], dim=-2)
