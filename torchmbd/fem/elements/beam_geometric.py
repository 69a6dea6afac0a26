"""Geometric stiffness of beams: all six section forces on rotations, slopes and curvatures.

    second-order strains       gamma2 = -phi x u' + 1/2 phi x (phi x t),      kappa2 = -1/2 phi x phi'
    u' Kg u = 2 integral of F . gamma2 + M . kappa2

phi, u'  rotation of the section and slope of the line, of the motion inside an element under forces at its ends (beam.py):
         phi = phi_1 + integral of kappa,   u' = phi x t + gamma
F, M     force and moment of the section under the given stress, at the stations

They are the strains of a geometrically exact beam to the second order; so twist, shear, eccentric sections, moments and
torsion are in it, and a rigid rotation of a stressed beam does the work of its loads, exactly. Moments at the ends are those
that belong to rotation vectors (semitangential ones).
Source: J. C. Simo, Comput. Methods Appl. Mech. Eng. 49 (1985) 55-70, expanded here.
Checked in tests/fem/elements/test_geometric.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements.beam import BeamMatrices
from torchmbd.fem.elements.geometric import StressedCells, corner_motions
from torchmbd.math.quadratic_forms import factors
from torchmbd.math.rigid_motion import hat


def stressed_beams(
    matrices: BeamMatrices, stiffness: Float[Tensor, "*lanes m g 6 6"], motion: Float[Tensor, "*lanes n 6 k"]
) -> list[StressedCells]:
    """Return the stressed cells under the section forces of k motions; stiffness as of `BeamMatrices.values`."""
    stations = matrices.station_rows(stiffness)
    forces = stations.forces @ corner_motions(matrices.elements, motion)[..., None, :, :]
    F, M = forces.movedim(-1, -4).split(3, dim=-1)  # [*lanes, k, m, g, 3]
    law = _law(F, M, stations.tangent.unsqueeze(-4)) * stations.weight[..., None, :, :, None, None]
    return [StressedCells(matrices.elements, stations.rows.unsqueeze(-2), factors(law))]


def _law(F: Tensor, M: Tensor, t: Tensor) -> Float[Tensor, "*lanes k m g 9 9"]:
    """L on phi, u', kappa."""
    t, _ = torch.broadcast_tensors(t, F)
    both = F[..., :, None] * t[..., None, :]
    eye = torch.eye(3, dtype=F.dtype)
    turned = 0.5 * (both + both.mT) - (F * t).sum(-1)[..., None, None] * eye
    none, f, m = torch.zeros_like(turned), hat(F), 0.5 * hat(M)
    rows = [torch.cat(row, -1) for row in ((turned, f, m), (f.mT, none, none), (m.mT, none, none))]
    return torch.cat(rows, -2)
