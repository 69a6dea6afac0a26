"""The isotropic plate that a laminate is on average over all directions in its plane.

    U1 = (3 X11 + 3 X22 + 2 X12 + 4 X66) / 8,   U4 = (X11 + X22 + 6 X12 - 4 X66) / 8     of X = A or D
    poisson        = U4(A) / U1(A)
    shear_length   = sqrt(12 U1(D) / ((As_xz + As_yz) / 2))     [m]
    bending_length = sqrt(12 U1(D) / U1(A))                    [m], the thickness of a homogeneous plate
    layer_length   = sqrt(D66 / As), with the same poisson for D    [m], in which twist becomes shear at a free edge

U1, U4 and the trace of As do not change when a ply is turned, so these numbers depend on plies and thicknesses but
on no ply angle. That is why an element may use them as constants and still be linear in the laminate's entries.
Where the laminate takes As from the energy (shear_correction = "energy"), As does depend on the angles; the mean is then
that of the stack whose every ply is replaced by its own isotropic mean.
Source: S. W. Tsai and N. J. Pagano, Invariant properties of composite materials (1968); Jones, section 2.7.
Checked in tests/fem/materials/test_isotropic_mean.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials.laminate import Laminate, LaminateStiffness
from torchmbd.fem.materials.transverse_shear import energy_shear_stiffness, shear_shape


@dataclass(frozen=True)
class IsotropicMean:
    """Poisson's ratio in the plane, and the lengths [m] below which transverse shear and membrane forces dominate bending.

    An infinite bending_length is that of a flat plate, whatever the mesh.
    """

    poisson: float
    shear_length: float
    bending_length: float = math.inf

    def __post_init__(self) -> None:
        if not -1.0 < self.poisson < 1.0:
            raise InputError(f"IsotropicMean: poisson = {self.poisson!r}; allowed: -1 < poisson < 1")
        if not 0.0 < self.shear_length < math.inf:
            raise InputError(f"IsotropicMean: shear_length = {self.shear_length!r} m; allowed: a finite number > 0")
        if not self.bending_length > 0.0:
            raise InputError(f"IsotropicMean: bending_length = {self.bending_length!r} m; allowed: a number > 0")

    @property
    def layer_length(self) -> float:
        """Shear along a free edge falls as exp(-y / layer_length) [m]."""
        return self.shear_length * math.sqrt((1.0 - self.poisson) / 24.0)

    @classmethod
    def of(cls, laminate: Laminate | LaminateStiffness) -> IsotropicMean:
        """Average one laminate (no lanes)."""
        stiffness = laminate.stiffness() if isinstance(laminate, Laminate) else laminate
        A, D, As = (x.detach() for x in (stiffness.A, stiffness.D, stiffness.As))
        if A.ndim != 2:
            raise InputError(f"IsotropicMean.of: A has shape {tuple(A.shape)}; allowed: one laminate, [3, 3]")
        if isinstance(laminate, Laminate) and laminate.shear_correction == "energy":
            As = _shear_of_isotropic_plies(laminate)
        shear = (As[0, 0] + As[1, 1]) / 2.0
        bending = 12.0 * _U1(D)
        return cls(float(_U4(A) / _U1(A)), float((bending / shear).sqrt()), float((bending / _U1(A)).sqrt()))


def _U1(X: Tensor) -> Tensor:
    return (3.0 * X[0, 0] + 3.0 * X[1, 1] + 2.0 * X[0, 1] + 4.0 * X[2, 2]) / 8.0


def _U4(X: Tensor) -> Tensor:
    return (X[0, 0] + X[1, 1] + 6.0 * X[0, 1] - 4.0 * X[2, 2]) / 8.0


def _shear_of_isotropic_plies(laminate: Laminate) -> Tensor:
    with torch.no_grad():
        Q, G = laminate.layer_stiffness
        direct, mixed = _U1(Q.movedim(0, -1)), _U4(Q.movedim(0, -1))
        mean_Q = torch.zeros_like(Q)
        mean_Q[:, 0, 0] = mean_Q[:, 1, 1] = direct
        mean_Q[:, 0, 1] = mean_Q[:, 1, 0] = mixed
        mean_Q[:, 2, 2] = (direct - mixed) / 2.0
        mean_G = G.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * torch.eye(2, dtype=G.dtype)
        z = laminate.faces
        A, B, D = (((z[:, 1] ** n - z[:, 0] ** n) / n)[:, None, None] * mean_Q for n in (1, 2, 3))
        return energy_shear_stiffness(shear_shape(mean_Q, z, A.sum(0), B.sum(0), D.sum(0)), mean_G)
