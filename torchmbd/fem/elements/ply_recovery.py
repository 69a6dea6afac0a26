"""Ply strains and stresses of a plate: from nodal displacements to the bottom and top of every layer.

    section strains   (eps, kappa, gamma) at the middle of each cell, where the element's strains are best
    ply values        maps of the laminate (fem/materials/ply_maps.py) times the section strains

Both steps are linear, so displacement fields may be modes: `stress = basis.stress @ w` is then one product for a
whole trajectory of modal coordinates w.
Differentiable, forward and reverse, in the laminate's parameters and in the displacements, with lanes.
Checked in tests/fem/elements/test_ply_recovery.py and tests/validation/test_ply_stresses.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.fem.elements.plate import PlateMatrices
from torchmbd.fem.materials import Laminate, ply_maps


class PlyBasis(NamedTuple):
    """Ply strains and stresses [Pa] of k displacement fields at all points, components (11, 22, 12, 13, 23).

    Points run over cells, layers (bottom to top) and faces (bottom, top), in this order; see `ply_points`.
    """

    strain: Float[Tensor, "*lanes points 5 k"]
    stress: Float[Tensor, "*lanes points 5 k"]


def ply_basis(matrices: PlateMatrices, laminate: Laminate, displacements: Float[Tensor, "*lanes n 6 k"]) -> PlyBasis:
    """Recover the plies of k fields of nodal displacements (u1 u2 u3 phi1 phi2 phi3 of each node, mesh axes)."""
    section = matrices.section_strains(displacements, laminate.stiffness(), matrices.moved_mean(laminate))
    section = section[..., :, None, None, :, :]
    cells = (lambda x: x[..., matrices.zones, :, :, :, :]) if matrices.several else (lambda x: x.unsqueeze(-5))
    strain, stress = (cells(maps) @ section for maps in ply_maps(laminate))
    return PlyBasis(strain.flatten(-5, -3), stress.flatten(-5, -3))


def ply_points(matrices: PlateMatrices, laminate: Laminate) -> Int[Tensor, "points 3"]:
    """Cell, layer from the bottom, and face (0 bottom, 1 top) of every point of a PlyBasis."""
    layers, faces = torch.arange(len(laminate.layer_plies)), torch.arange(2)
    return torch.cartesian_prod(matrices.members, layers, faces)
