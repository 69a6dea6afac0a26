"""An orthotropic solid of nine constants, for sections, where stresses are not plane.

    (eps_11, eps_22, eps_33, gamma_23, gamma_13, gamma_12) = C^-1 (sig_11, sig_22, sig_33, tau_23, tau_13, tau_12)

E1, E2, E3         moduli along the fiber (1), across it in the ply (2), through the ply (3)   [Pa]
G12, G13, G23      shear moduli                                                                [Pa]
nu12, nu13, nu23   nu_ij: strain along j for a stress along i, with a minus sign
density            [kg/m3]
strength           of the ply that it is, or None

A `Ply` lacks what plane stress does not need. It is completed as transversely isotropic: E3 = E2, nu13 = nu12,
nu23 = E2 / (2 G23) - 1.
Assumed: linear elastic, positive strain energy.
Source: R. M. Jones, Mechanics of Composite Materials, 2nd ed., section 2.4.
Checked in tests/fem/sections/test_orthotropic.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials import Strength
from torchmbd.fem.materials.ply import IsotropicPly, Lamina, check_isotropic
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.plausible_units import warn_unusual_material
from torchmbd.math.variable import check_positive, is_variable, number, stacked, varies, with_fields, without_variables


@dataclass(frozen=True)
class Orthotropic:
    """Elastic constants [Pa] and density [kg/m3] of a solid in its own axes (1 = fiber, 3 = through the ply).

    A number may be mbd.variable(...): a design variable of the sections that are made of it, "ply.E1".
    """

    positive: ClassVar[tuple[str, ...]] = ("E1", "E2", "E3", "G12", "G13", "G23", "density")
    E1: float | Tensor
    E2: float | Tensor
    E3: float | Tensor
    G12: float | Tensor
    G13: float | Tensor
    G23: float | Tensor
    nu12: float | Tensor
    nu13: float | Tensor
    nu23: float | Tensor
    density: float | Tensor
    strength: Strength | None = None

    def __post_init__(self) -> None:
        check_positive(self)
        for name in ("nu12", "nu13", "nu23"):
            value = number(getattr(self, name))
            if not (is_real(value) and math.isfinite(value)):
                raise InputError(
                    name, value, "a finite number, or mbd.variable(...) of one", noun=f"Orthotropic: {name}"
                )
        numbers = without_variables(self)
        normal = numbers._compliance()[:3, :3]
        scale = normal.diagonal().rsqrt()
        if not float(torch.linalg.eigvalsh(scale[:, None] * normal * scale).min()) > 1e-9:
            raise InputError(
                "nu12",
                numbers.nu12,
                "must have |nu_ij| < sqrt(E_i / E_j), and a positive determinant of the 3 x 3 "
                "compliance of the normal stresses",
                noun="Orthotropic: nu12",
                shown=f"{numbers.nu12!r}, nu13 = {numbers.nu13!r}, nu23 = {numbers.nu23!r}",
                state="make the compliance not positive definite",
            )
        moduli = {name: getattr(numbers, name) for name in ("E1", "E2", "E3", "G12", "G13", "G23")}
        warn_unusual_material("Orthotropic", moduli, numbers.density, numbers.strength.Xt if numbers.strength else None)

    @classmethod
    def isotropic(cls, E: float | Tensor, nu: float | Tensor, density: float | Tensor) -> Orthotropic | IsotropicPly:
        """Make a metal: one modulus [Pa], Poisson's ratio in (-1, 0.5), density [kg/m3].

        Each may be mbd.variable(...): a design variable, "section.ply.E".
        """
        check_isotropic("Orthotropic.isotropic", E, nu, math.nextafter(0.5, 0.0))
        if is_variable(E) or is_variable(nu):
            return IsotropicPly(E, nu, density)
        G = E / (2.0 * (1.0 + nu))
        return cls(E, E, E, G, G, G, nu, nu, nu, density)

    @classmethod
    def of(cls, ply: Lamina | Orthotropic) -> Orthotropic:
        """Complete a ply as transversely isotropic; InputError if its G23 admits no such solid."""
        if isinstance(ply, Orthotropic):
            return ply
        if not isinstance(ply, Lamina):
            raise InputError("ply", ply, "a Ply or an Orthotropic")
        if varies(ply):
            raise InputError(
                "ply",
                ply,
                "must have numbers that do not vary",
                state=f"is {ply!r}, whose numbers vary",
                hint="a Section of the ply itself",
            )
        if ply.loss:
            raise InputError(
                "ply",
                ply,
                "must have the loss factor 0",
                hint="damping of the modes of the body",
                noun="ply of a section",
                state=f"has the loss factor {ply.loss!r}",
            )
        nu23 = ply.E2 / (2.0 * ply.G23) - 1.0
        try:
            moduli = (ply.E1, ply.E2, ply.E2, ply.G12, ply.G13, ply.G23)
            return cls(*moduli, ply.nu12, ply.nu12, nu23, ply.density, ply.strength)
        except InputError as error:
            raise InputError(
                "ply",
                noun=f"ply with E2 = {ply.E2!r}, G23 = {ply.G23!r}",
                state=f"is not a transversely isotropic solid (nu23 = E2 / (2 G23) - 1 = {nu23:.4g})",
                hint="an Orthotropic, which has all nine constants",
            ) from error

    def of_design(self, ply: Lamina | Orthotropic) -> Orthotropic:
        """Return the solid with the numbers of a design, [] or [lanes], of the ply that it was made of; unchecked."""
        if isinstance(ply, Orthotropic):
            return ply
        properties = {
            name: getattr(ply, name) for name in ("E1", "E2", "G12", "G13", "G23", "nu12", "density", "strength")
        }
        return with_fields(self, properties | {"E3": ply.E2, "nu13": ply.nu12, "nu23": ply.E2 / (2.0 * ply.G23) - 1.0})

    def stiffness(self) -> Float[Tensor, "*lanes 6 6"]:
        """C [Pa] for strains (11, 22, 33, 23, 13, 12), shear strains gamma."""
        return torch.linalg.inv(self._compliance())

    def _compliance(self) -> Float[Tensor, "*lanes 6 6"]:
        s12, s13, s23 = -self.nu12 / self.E1, -self.nu13 / self.E1, -self.nu23 / self.E2
        normal = ((1.0 / self.E1, s12, s13), (s12, 1.0 / self.E2, s23), (s13, s23, 1.0 / self.E3))
        shear = (1.0 / self.G23, 1.0 / self.G13, 1.0 / self.G12)
        rows = [[*row, 0.0, 0.0, 0.0] for row in normal]
        rows += [[0.0] * (3 + k) + [x] + [0.0] * (2 - k) for k, x in enumerate(shear)]
        return stacked([x for row in rows for x in row]).unflatten(-1, (6, 6))


def in_wall_axes(
    C: Float[Tensor, "layers 6 6"], theta: Float[Tensor, "*lanes layers"]
) -> Float[Tensor, "*lanes layers 6 6"]:
    """Return the stiffness in wall axes (x, s, n) of plies whose fiber lies at theta from x to s: T' C T."""
    T = strain_rotation(theta)
    return T.mT @ C @ T


def strain_rotation(theta: Float[Tensor, "*lanes layers"]) -> Float[Tensor, "*lanes layers 6 6"]:
    """Return T, which maps strains (xx, ss, nn, sn, xn, xs) of the wall to (11, 22, 33, 23, 13, 12) of the ply."""
    c, s = torch.cos(theta), torch.sin(theta)
    o, unit = torch.zeros_like(c), torch.ones_like(c)
    rows = [
        [c * c, s * s, o, o, o, c * s],
        [s * s, c * c, o, o, o, -c * s],
        [o, o, unit, o, o, o],
        [o, o, o, c, -s, o],
        [o, o, o, s, c, o],
        [-2 * c * s, 2 * c * s, o, o, o, c * c - s * s],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
