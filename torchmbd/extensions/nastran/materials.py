"""Plies from the material cards of a Nastran model, in SI units.

    MAT1, MAT8    -> Ply; strengths where all are given (MAT8: Xt, Xc, Yt, Yc, S; F12 as Tsai-Wu's interaction); coefficients
                     of thermal expansion (A; A1, A2), per degree of the file, None where they are blank

Shells: shells.py, sections of bars: sections.py. G1Z, G2Z of MAT8 that are blank mean infinite stiffness in Nastran; here they
are taken as G12, with a warning.
Checked in tests/extensions/nastran/test_read_bdf.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchmbd.errors import InputError, unknown, warn, within, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.fem.materials import Ply, Strength
from torchmbd.math.units import FOOT, GRAVITY, INCH, POUND


@dataclass(frozen=True)
class Units:
    """Units of a file in SI."""

    length: float
    mass: float

    @property
    def stress(self) -> float:
        return self.mass / self.length

    @property
    def density(self) -> float:
        return self.mass / self.length**3

    @property
    def per_area(self) -> float:
        return self.mass / self.length**2


UNITS = {
    "m": Units(1.0, 1.0),  # m, kg, s, N, Pa
    "mm": Units(1e-3, 1e3),  # mm, t, s, N, MPa
    "cm": Units(1e-2, 1e2),  # cm, N s2/cm, s, N, N/cm2
    "in": Units(INCH, POUND * GRAVITY / INCH),  # in, lbf s2/in, s, lbf, psi
    "ft": Units(FOOT, POUND * GRAVITY / FOOT),  # ft, slug, s, lbf, lbf/ft2
}


def units_of(name: str) -> Units:
    """The units by name."""
    if not isinstance(name, str) or name not in UNITS:
        raise unknown("units", name, UNITS)
    return UNITS[name]


def ply_of(card: Card, units: Units, weight_to_mass: float = 1.0) -> Ply:
    """Make the ply of a MAT1 or MAT8."""
    try:
        if card.name not in ("MAT1", "MAT8"):
            raise wrong_entry(card, "it is the material of a shell or a beam", "MAT1 or MAT8")
        return _isotropic(card, units, weight_to_mass) if card.name == "MAT1" else _ply(card, units, weight_to_mass)
    except InputError as error:
        raise error if str(error.path[0]).startswith(card.name) else within(card, error) from None


def with_density(cards: dict[int, Card], density: float, units: Units, weight_to_mass: float) -> dict[int, Card]:
    """Return materials whose blank RHO is replaced by a density [kg/m3], in units of the file."""
    text = repr(density / units.density / weight_to_mass).upper()
    materials = {}
    for number, card in cards.items():
        place = {"MAT1": 5, "MAT2": 8, "MAT8": 8, "MAT9": 23}.get(card.name, 0)
        fields = [*card.fields, *[""] * (place - len(card.fields))]
        if place and not fields[place - 1]:
            fields[place - 1] = text
        materials[number] = Card(card.name, tuple(fields), card.where)
    return materials


def density_of(card: Card, position: int, units: Units, weight_to_mass: float) -> float:
    density = card.real(position, "RHO", 0.0)
    if density <= 0.0:
        allowed = "a density > 0, because a body needs mass (read_bdf takes one, `density`, for all that lack it)"
        raise InputError((str(card), "RHO"), card.text(position), allowed, noun=f"{card}: RHO")
    return density * units.density * weight_to_mass


def moduli_of(card: Card) -> tuple[float, float, float]:
    """E, G and NU of a MAT1 in units of the file."""
    if card.name != "MAT1":
        raise wrong_entry(card, "it is the material of a rod or a metal", "MAT1")
    E, G = card.real(2, "E", 0.0), card.real(3, "G", 0.0)
    nu = card.real(4, "NU") if card.text(4) else None
    if nu is None and E and G:
        nu = E / (2.0 * G) - 1.0
    if nu is None or not (E or G) or not -1.0 < nu < 0.5:
        raise wrong_entry(
            card, f"E {E:g}, G {G:g}, NU {nu}", "must have two of E, G, NU, the last between -1 and 0.5", key="E"
        )
    E = E or 2.0 * G * (1.0 + nu)
    G = G or E / (2.0 * (1.0 + nu))
    if not (E > 0.0 and G > 0.0):
        raise wrong_entry(card, f"E {E:g}, G {G:g}", "both above 0", key="E")
    return E, G, nu


def _isotropic(card: Card, units: Units, weight_to_mass: float) -> Ply:
    E, G, nu = moduli_of(card)
    E, G = E * units.stress, G * units.stress
    limits = [card.real(k, name, 0.0) * units.stress for k, name in ((9, "ST"), (10, "SC"), (11, "SS"))]
    tension, compression, shear = limits
    strength = Strength(tension, compression, tension, compression, shear) if min(limits) > 0 else None
    (alpha,) = _expansion(card, (6, "A"))
    density = density_of(card, 5, units, weight_to_mass)
    return Ply(E, E, G, G, G, nu, density, strength, alpha1=alpha, alpha2=alpha)


def _expansion(card: Card, *fields: tuple[int, str]) -> list[float | None]:
    """Coefficients of thermal expansion; None if all are blank, and zero for one that is blank beside others."""
    expands = any(card.text(k) for k, _ in fields)
    return [card.real(k, name, 0.0) if expands else None for k, name in fields]


def _ply(card: Card, units: Units, weight_to_mass: float) -> Ply:
    E1, E2, G12 = (card.real(k, name) * units.stress for k, name in ((2, "E1"), (3, "E2"), (5, "G12")))
    across = []
    for k, name in ((6, "G1Z"), (7, "G2Z")):
        value = card.real(k, name, 0.0) * units.stress
        if value == 0.0:
            warn(f"{card}: {name} is blank (infinite in Nastran); taken as G12")
        across.append(value or G12)
    Xt, Yt, S = (card.real(k, name, 0.0) * units.stress for k, name in ((12, "Xt"), (14, "Yt"), (16, "S")))
    Xc, Yc = (card.real(k, name, 0.0) * units.stress or other for k, name, other in ((13, "Xc", Xt), (15, "Yc", Yt)))
    strength = None
    if min(Xt, Xc, Yt, Yc, S) > 0.0:
        if card.real(19, "STRN", 0.0) == 1.0:
            warn(f"{card}: the reader leaves out allowable strains (STRN = 1). Try: allowable stresses")
        else:
            F12 = card.real(18, "F12", 0.0) / units.stress**2
            strength = Strength(Xt, Xc, Yt, Yc, S, interaction=F12 * math.sqrt(Xt * Xc * Yt * Yc))
    density = density_of(card, 8, units, weight_to_mass)
    alpha1, alpha2 = _expansion(card, (9, "A1"), (10, "A2"))
    nu12 = card.real(4, "NU12")
    return Ply(E1, E2, G12, across[0], across[1], nu12, density, strength, alpha1=alpha1, alpha2=alpha2)
