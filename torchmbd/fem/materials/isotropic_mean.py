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
Differentiable, with lanes, in thicknesses and numbers of plies (`present_mean`).
Source: S. W. Tsai and N. J. Pagano, Invariant properties of composite materials (1968); Jones, section 2.7.
Checked in tests/fem/materials/test_isotropic_mean.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials.laminate import Laminate, LaminateStiffness, plane_invariants


@dataclass(frozen=True)
class IsotropicMean:
    """Poisson's ratio in the plane, and the lengths [m] below which transverse shear and membrane forces dominate bending.

    Numbers, or one for each of m cells. An infinite bending_length is that of a flat plate, whatever the mesh.
    """

    poisson: Any
    shear_length: Any
    bending_length: Any = math.inf

    def __post_init__(self) -> None:
        if isinstance(self.poisson, Tensor):
            return
        if not -1.0 < self.poisson < 1.0:
            raise InputError(
                "poisson",
                self.poisson,
                "above -1 and below 1",
                noun="IsotropicMean: poisson",
            )
        if not 0.0 < self.shear_length < math.inf:
            raise InputError(
                "shear_length",
                self.shear_length,
                "a finite number > 0",
                noun="IsotropicMean: shear_length",
                shown=f"{self.shear_length!r} m",
            )
        if not self.bending_length > 0.0:
            raise InputError(
                "bending_length",
                self.bending_length,
                "a number > 0",
                noun="IsotropicMean: bending_length",
                shown=f"{self.bending_length!r} m",
            )

    @property
    def layer_length(self) -> Any:
        """Shear along a free edge falls as exp(-y / layer_length) [m]."""
        return self.shear_length * ((1.0 - self.poisson) / 24.0) ** 0.5

    def of_cells(self, m: int) -> IsotropicMean:
        """The same numbers for each of m cells."""
        if isinstance(self.poisson, Tensor):
            return self
        numbers = (self.poisson, self.shear_length, self.bending_length)
        return IsotropicMean(*(torch.full((m,), x, dtype=torch.float64) for x in numbers))

    @classmethod
    def of(cls, laminate: Laminate | LaminateStiffness) -> IsotropicMean:
        """Average one laminate (no lanes)."""
        with torch.no_grad():
            stiffness = laminate.isotropic_stiffness() if isinstance(laminate, Laminate) else laminate
            if stiffness.A.ndim != 2:
                raise InputError(
                    "laminate",
                    allowed="must have shape [3, 3], of one laminate",
                    state=f"has shape {tuple(stiffness.A.shape)}",
                    noun="IsotropicMean.of: A",
                )
            return cls(*_numbers(stiffness).tolist())


def present_mean(laminate: Laminate) -> Float[Tensor, "*lanes 3"]:
    """poisson, shear_length and bending_length of the present design; differentiable in thicknesses and numbers of plies."""
    return _numbers(laminate.isotropic_stiffness())


def _numbers(X: LaminateStiffness) -> Float[Tensor, "*lanes 3"]:
    (membrane, mixed), (bending, _) = plane_invariants(X.A), plane_invariants(12.0 * X.D)
    shear = X.As.diagonal(dim1=-2, dim2=-1).mean(-1)
    return torch.stack([mixed / membrane, (bending / shear).sqrt(), (bending / membrane).sqrt()], -1)
