"""Shear forces of plate cells from equilibrium, for the stresses of plies and between them.

    Q_x = M_xx,x + M_xy,y     Q_y = M_xy,x + M_yy,y     M,x = (D - B A^-1 B) kappa,x

An element leaves a part of the gaps at its sides to shear by the mean stiffness of the laminate over all directions (sides.py).
That makes K good, but As gamma is no measure of Q unless cells are as short as the plate is thick: in thin carbon plates it is
up to half too small. In a strip with gap g and the shares 1 / (1 + phi) of bending and phi / (1 + phi) of shear, the
element's energy is

    1/2 (12 D / L^2 / (1 + phi)^2 + As (phi / (1 + phi))^2) g^2,     whose derivative by g is Q

that is equilibrium of the element's moments times the share of bending and As gamma times that of shear. Cells take both so:

    Q = P (kappa,x kappa,y) / (1 + phi) + As gamma phi / (1 + phi)     P: the sum of equilibrium above

Exact for linear moments of strips, in thick cells and in thin ones. Membrane forces are taken as constant over the cell, as in
the spread of Q through the thickness (transverse_shear.py); the rotary inertia of the plate is left out.
Differentiable, forward and reverse, in the laminate and the displacements, with lanes.
Checked in tests/fem/elements/test_shear_recovery.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements.strains import ShearRecovery
from torchmbd.fem.materials import LaminateStiffness

_PARTS = torch.tensor([[0, 2], [2, 1]])  # moments (xx, yy, xy) whose derivatives by x and y are Q_x, Q_y


def shear_strains(
    shear: ShearRecovery, law: LaminateStiffness, displacements: Float[Tensor, "*lanes m f k"]
) -> Float[Tensor, "*lanes m 2 k"]:
    """Return As^-1 Q of every cell; law: of one laminate [*lanes, 1, ...] or of each cell [*lanes, m, ...]."""
    D = law.D - law.B @ torch.linalg.inv(law.A) @ law.B  # not solve: its tangents under vmap are wrong (torch 2.13)
    P = D[..., _PARTS, :].flatten(-2)
    bending = torch.linalg.inv(law.As) @ P @ (shear.slopes.flatten(-3, -2) @ displacements)
    return bending + shear.strain @ displacements
