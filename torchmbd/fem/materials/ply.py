"""One unidirectional ply: an orthotropic, homogeneous layer in plane stress.

    eps_11 = sig_11 / E1 - nu12 sig_22 / E1      gamma_12 = tau_12 / G12
    eps_22 = sig_22 / E2 - nu12 sig_11 / E1      gamma_13 = tau_13 / G13,  gamma_23 = tau_23 / G23

E1, E2          moduli along and across the fiber      [Pa]
G12, G13, G23   shear moduli                           [Pa]
nu12            Poisson's ratio: strain along 2 for a stress along 1
density         [kg/m3]
strength        what failure criteria need (strength.py); None: no criterion is evaluated
loss            loss factor: energy lost in a radian over the strain energy at the turn  [-]
alpha1, alpha2  free strain along and across the fiber for a change of temperature  [1/K]
beta1, beta2    free strain along and across the fiber for a change of moisture, a share of the mass  [-]

Assumed: linear elastic; the strain energy is positive, that is E1, E2, G > 0 and nu12^2 < E1 / E2.
Source: R. M. Jones, Mechanics of Composite Materials, 2nd ed., sections 2.4-2.5.
Checked in tests/fem/materials/test_ply.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, keyword_hints
from torchmbd.fem.materials.strength import Strength
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.plausible_units import warn_unusual_material
from torchmbd.math.variable import check_positive, is_variable, number, stacked, without_variables


class Lamina:
    """What laminates and sections ask of a layer: its constants, numbers or tensors, and these two stiffnesses."""

    E1: Any
    E2: Any
    G12: Any
    G13: Any
    G23: Any
    nu12: Any
    density: Any
    strength: Any
    loss: Any
    alpha1: Any
    alpha2: Any
    beta1: Any
    beta2: Any

    def plane_stiffness(self) -> Float[Tensor, "*lanes 3 3"]:
        """Reduced stiffness Q of plane stress [Pa]: (sig_11, sig_22, tau_12) = Q (eps_11, eps_22, gamma_12)."""
        nu21 = self.nu12 * self.E2 / self.E1
        d = 1.0 - self.nu12 * nu21
        mixed = self.nu12 * self.E2 / d
        rows = (self.E1 / d, mixed, 0.0, mixed, self.E2 / d, 0.0, 0.0, 0.0, self.G12)
        return stacked(rows).unflatten(-1, (3, 3))

    def shear_stiffness(self) -> Float[Tensor, "*lanes 2 2"]:
        """Transverse shear stiffness [Pa]: (tau_13, tau_23) = diag(G13, G23) (gamma_13, gamma_23)."""
        return torch.diag_embed(stacked((self.G13, self.G23)))


@keyword_hints
@dataclass(frozen=True)
class Ply(Lamina):
    """One unidirectional layer in its own axes (1 = fiber, 2 = across, 3 = thickness); for a metal use Ply.isotropic.

    E1, E2          moduli along and across the fiber [Pa]
    G12, G13, G23   shear moduli [Pa]
    nu12            Poisson's ratio, strain along 2 for a stress along 1; nu12^2 < E1 / E2
    density         [kg/m3]
    strength        a Strength, for criteria of failure; None: no criterion can be evaluated
    loss            loss factor of its strain energy [-], zero or positive: damping of the modes of plates (modal_damping.py)
    alpha1, alpha2  coefficients of thermal expansion along and across the fiber [1/K]
    beta1, beta2    coefficients of moisture expansion: strain per change of the moisture, which is a share of the mass [-]

    Laminate.expansion and mbd.Temperature need these coefficients: they refuse a change of temperature or moisture if they are
    None.

    A number may be mbd.variable(...): a design variable of the laminates and sections that are made of the ply, "ply.E1".

    >>> carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> round(steel.G12 / 1e9, 2)  # E / 2 (1 + nu) [GPa]
    80.77
    """

    positive: ClassVar[tuple[str, ...]] = ("E1", "E2", "G12", "G13", "G23", "density")
    nonnegative: ClassVar[tuple[str, ...]] = ("loss",)
    E1: float | Tensor
    E2: float | Tensor
    G12: float | Tensor
    G13: float | Tensor
    G23: float | Tensor
    nu12: float | Tensor
    density: float | Tensor
    strength: Strength | None = None
    loss: float | Tensor = 0.0
    alpha1: float | Tensor | None = None
    alpha2: float | Tensor | None = None
    beta1: float | Tensor | None = None
    beta2: float | Tensor | None = None

    def __post_init__(self) -> None:
        check_positive(self)
        _check_expansion(self, ("alpha1", "alpha2", "beta1", "beta2"))
        loss = number(self.loss)
        if not (is_real(loss) and math.isfinite(loss) and loss >= 0.0):
            raise InputError(
                "loss",
                loss,
                "zero or positive, or mbd.variable(...) of such a number",
                noun="Ply: loss",
            )
        nu12 = number(self.nu12)
        if not (is_real(nu12) and math.isfinite(nu12)):
            raise InputError("nu12", nu12, "a finite number, or mbd.variable(...) of one", noun="Ply: nu12")
        limit = math.sqrt(number(self.E1) / number(self.E2))
        if abs(nu12) >= limit:
            raise InputError(
                "nu12",
                nu12,
                f"below sqrt(E1 / E2) = {limit:.6g} in magnitude",
                noun="Ply: nu12",
                shown=repr(nu12),
                state="makes the ply stiffness not positive definite",
            )
        if not (self.strength is None or isinstance(self.strength, Strength)):
            raise InputError("strength", self.strength, "a Strength, or None", noun="Ply: strength")
        numbers = without_variables(self)
        moduli = {name: getattr(numbers, name) for name in ("E1", "E2", "G12", "G13", "G23")}
        warn_unusual_material("Ply", moduli, numbers.density, numbers.strength.Xt if numbers.strength else None)

    @classmethod
    def isotropic(
        cls,
        E: float | Tensor,
        nu: float | Tensor,
        density: float | Tensor,
        strength: Strength | None = None,
        loss: float | Tensor = 0.0,
        alpha: float | Tensor | None = None,
        beta: float | Tensor | None = None,
    ) -> Ply | IsotropicPly:
        """Make the ply of an isotropic material, such as a metal.

        E, nu, density  modulus [Pa], Poisson's ratio in (-1, 0.5], density [kg/m3]
        strength, loss  as in Ply
        alpha, beta     coefficients of thermal expansion [1/K] and of moisture expansion [-], as in Ply

        A number may be mbd.variable(...): a design variable, "plate.laminate.ply.E".
        """
        check_isotropic("Ply.isotropic", E, nu, 0.5)
        if any(is_variable(x) for x in (E, nu, alpha, beta)):
            return IsotropicPly(E, nu, density, strength, loss, alpha, beta)
        G = E / (2.0 * (1.0 + nu))
        return cls(E, E, G, G, G, nu, density, strength, loss, alpha, alpha, beta, beta)


@dataclass(frozen=True)
class IsotropicPly(Lamina):
    """The ply of a metal whose modulus or Poisson's ratio varies; made by `Ply.isotropic`."""

    positive: ClassVar[tuple[str, ...]] = ("E", "density")
    nonnegative: ClassVar[tuple[str, ...]] = ("loss",)
    E: float | Tensor
    nu: float | Tensor
    density: float | Tensor
    strength: Strength | None = None
    loss: float | Tensor = 0.0
    alpha: float | Tensor | None = None
    beta: float | Tensor | None = None

    def __post_init__(self) -> None:
        _check_expansion(self, ("alpha", "beta"))
        E, nu, density = (number(x) for x in (self.E, self.nu, self.density))
        Ply.isotropic(E, nu, density, self.strength, self.loss)  # the checks of a ply

    @property
    def E1(self) -> float | Tensor:
        """[Pa]"""
        return self.E

    E2 = E1

    @property
    def nu12(self) -> float | Tensor:
        """[-]"""
        return self.nu

    @property
    def G12(self) -> float | Tensor:
        """[Pa]"""
        return self.E / (2.0 * (1.0 + self.nu))

    G13 = G23 = G12

    @property
    def alpha1(self) -> float | Tensor | None:
        """[1/K]"""
        return self.alpha

    @property
    def beta1(self) -> float | Tensor | None:
        """[-]"""
        return self.beta

    alpha2, beta2 = alpha1, beta1


def _check_expansion(ply: Any, names: tuple[str, ...]) -> None:
    """InputError unless the coefficients of expansion are finite numbers, variables or None."""
    for name in names:
        value = number(getattr(ply, name))
        if not (value is None or (is_real(value) and math.isfinite(value))):
            allowed = "a finite number, mbd.variable(...) of one, or None"
            raise InputError(name, value, allowed, noun=f"Ply: {name}")


def check_isotropic(name: str, E: Any, nu: Any, most: float) -> None:
    """InputError unless E and nu, or the values of variables, are those of a metal; `most`: the largest nu."""
    ratio, modulus = number(nu), number(E)
    if not (is_real(ratio) and -1.0 < ratio <= most):
        raise InputError(
            "nu",
            ratio,
            f"above -1 and at most {most:g}, or mbd.variable(...) of such a number",
            noun=f"{name}: nu",
        )
    if not (is_real(modulus) and 0.0 < modulus < math.inf):
        raise InputError(
            "E",
            modulus,
            "a finite number > 0, or mbd.variable(...) of one",
            noun=f"{name}: E",
        )
