"""One unidirectional ply: an orthotropic, homogeneous layer in plane stress.

    eps_11 = sig_11 / E1 - nu12 sig_22 / E1      gamma_12 = tau_12 / G12
    eps_22 = sig_22 / E2 - nu12 sig_11 / E1      gamma_13 = tau_13 / G13,  gamma_23 = tau_23 / G23

E1, E2          moduli along and across the fibre      [Pa]
G12, G13, G23   shear moduli                           [Pa]
nu12            Poisson's ratio: strain along 2 for a stress along 1
density         [kg/m3]
strength        what failure criteria need (strength.py); None where nobody asks for it

Assumed: linear elastic; the strain energy is positive, that is E1, E2, G > 0 and nu12^2 < E1 / E2.
Source: R. M. Jones, Mechanics of Composite Materials, 2nd ed., sections 2.4-2.5.
Checked in tests/fem/materials/test_ply.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials.strength import Strength
from torchmbd.math.plausible_units import doubt_material


@dataclass(frozen=True)
class Ply:
    """One unidirectional layer in its own axes (1 = fibre, 2 = across, 3 = thickness); Ply.isotropic makes a metal's.

    E1, E2          moduli along and across the fibre [Pa]
    G12, G13, G23   shear moduli [Pa]
    nu12            Poisson's ratio, strain along 2 for a stress along 1; nu12^2 < E1 / E2
    density         [kg/m3]
    strength        a Strength, for criteria of failure; None: nobody asks for it
    """

    E1: float
    E2: float
    G12: float
    G13: float
    G23: float
    nu12: float
    density: float
    strength: Strength | None = None

    def __post_init__(self) -> None:
        for name in ("E1", "E2", "G12", "G13", "G23", "density"):
            value = getattr(self, name)
            if not (_is_number(value) and math.isfinite(value) and value > 0):
                raise InputError(f"Ply: {name} = {value!r}; allowed: a finite number > 0")
        if not (_is_number(self.nu12) and math.isfinite(self.nu12)):
            raise InputError(f"Ply: nu12 = {self.nu12!r}; allowed: a finite number")
        limit = math.sqrt(self.E1 / self.E2)
        if abs(self.nu12) >= limit:
            raise InputError(
                f"Ply: nu12 = {self.nu12!r} makes the ply stiffness not positive definite; "
                f"allowed: |nu12| < sqrt(E1 / E2) = {limit:.6g}"
            )
        if not (self.strength is None or isinstance(self.strength, Strength)):
            raise InputError(f"Ply: strength = {self.strength!r}; allowed: a Strength, or None")
        moduli = {name: getattr(self, name) for name in ("E1", "E2", "G12", "G13", "G23")}
        doubt_material("Ply", moduli, self.density, self.strength.Xt if self.strength else None)

    @classmethod
    def isotropic(cls, E: float, nu: float, density: float, strength: Strength | None = None) -> Ply:
        """Make the ply of a metal: one modulus [Pa], Poisson's ratio in (-1, 0.5], density [kg/m3]."""
        if not (_is_number(nu) and -1.0 < nu <= 0.5):
            raise InputError(f"Ply.isotropic: nu = {nu!r}; allowed: -1 < nu <= 0.5")
        G = E / (2.0 * (1.0 + nu))
        return cls(E1=E, E2=E, G12=G, G13=G, G23=G, nu12=nu, density=density, strength=strength)

    def plane_stiffness(self) -> Float[Tensor, "3 3"]:
        """Reduced stiffness Q of plane stress [Pa]: (sig_11, sig_22, tau_12) = Q (eps_11, eps_22, gamma_12)."""
        nu21 = self.nu12 * self.E2 / self.E1
        d = 1.0 - self.nu12 * nu21
        return torch.tensor(
            [
                [self.E1 / d, self.nu12 * self.E2 / d, 0.0],
                [self.nu12 * self.E2 / d, self.E2 / d, 0.0],
                [0.0, 0.0, self.G12],
            ],
            dtype=torch.float64,
        )

    def shear_stiffness(self) -> Float[Tensor, "2 2"]:
        """Transverse shear stiffness [Pa]: (tau_13, tau_23) = diag(G13, G23) (gamma_13, gamma_23)."""
        return torch.diag(torch.tensor([self.G13, self.G23], dtype=torch.float64))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
