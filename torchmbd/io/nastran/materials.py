"""Plies, laminates and beam sections from the property and material cards of a Nastran model, in SI units.

    MAT1, MAT8    -> Ply; strengths where all are given (MAT8: Xt, Xc, Yt, Yc, S; F12 as Tsai-Wu's interaction)
    PCOMP         -> Laminate, its angles design parameters; LAM = SYM is a symmetric one; transverse shear stiffness of
                     equal energy, which is right for sandwiches, too
    PSHELL        -> Laminate of one ply; its angle is no design parameter
    PBAR, PBARL (ROD, TUBE, BAR), PBEAM (the same at both ends)  -> GivenSection

Mass without stiffness (NSM) is spread over the thickness, or over the section. G1Z, G2Z of MAT8 that are blank mean
infinite stiffness in Nastran; here they are taken as G12, with a warning.
Checked in tests/multibody/bodies/test_from_bdf.py.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from torchmbd.errors import InputError, unknown, warn
from torchmbd.fem.elements import BeamSection, GivenSection
from torchmbd.fem.materials import Laminate, Ply, Strength
from torchmbd.io.nastran.cards import Card
from torchmbd.io.nastran.data import BulkData
from torchmbd.math.angles import deg
from torchmbd.math.units import FOOT, GRAVITY, INCH, POUND

RIGID_IN_SHEAR = 1e6  # in place of infinity: K1 or K2 zero, or blank on a PBAR


@dataclass(frozen=True)
class Units:
    """What a unit of the file is in SI."""

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
            raise InputError(f"{card}: it is the material of a shell or a beam; allowed: MAT1, MAT8")
        return _isotropic(card, units, weight_to_mass) if card.name == "MAT1" else _ply(card, units, weight_to_mass)
    except InputError as error:
        raise error if str(error).startswith(card.name) else InputError(f"{card}: {error}") from None


def density_of(card: Card, position: int, units: Units, weight_to_mass: float) -> float:
    density = card.real(position, "RHO", 0.0)
    if density <= 0.0:
        raise InputError(f"{card}: RHO is {card.text(position)!r}; allowed: a density > 0, a body needs mass")
    return density * units.density * weight_to_mass


def moduli_of(card: Card) -> tuple[float, float, float]:
    """E, G and NU of a MAT1 in units of the file."""
    if card.name != "MAT1":
        raise InputError(f"{card}: it is the material of a rod or a metal; allowed: MAT1")
    E, G = card.real(2, "E", 0.0), card.real(3, "G", 0.0)
    nu = card.real(4, "NU") if card.text(4) else None
    if nu is None and E and G:
        nu = E / (2.0 * G) - 1.0
    if nu is None or not (E or G):
        raise InputError(f"{card}: two of E, G, NU are needed")
    E = E or 2.0 * G * (1.0 + nu)
    G = G or E / (2.0 * (1.0 + nu))
    if not (E > 0.0 and G > 0.0 and -1.0 < nu < 0.5):
        raise InputError(f"{card}: E {E:g}, G {G:g}, NU {nu:g}; allowed: E and G > 0, NU between -1 and 0.5")
    return E, G, nu


def _isotropic(card: Card, units: Units, weight_to_mass: float) -> Ply:
    E, G, nu = moduli_of(card)
    E, G = E * units.stress, G * units.stress
    limits = [card.real(k, name, 0.0) * units.stress for k, name in ((9, "ST"), (10, "SC"), (11, "SS"))]
    tension, compression, shear = limits
    strength = Strength(tension, compression, tension, compression, shear) if min(limits) > 0 else None
    return Ply(E, E, G, G, G, nu, density_of(card, 5, units, weight_to_mass), strength)


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
            warn(f"{card}: allowable strains (STRN = 1) are left out; allowed: stresses")
        else:
            F12 = card.real(18, "F12", 0.0) / units.stress**2
            strength = Strength(Xt, Xc, Yt, Yc, S, interaction=F12 * math.sqrt(Xt * Xc * Yt * Yc))
    density = density_of(card, 8, units, weight_to_mass)
    return Ply(E1, E2, G12, across[0], across[1], card.real(4, "NU12"), density, strength)


def laminate_of(data: BulkData, card: Card, units: Units) -> Laminate:
    """Make the laminate of a PSHELL or PCOMP."""
    try:
        if card.name == "PSHELL":
            return _shell(data, card, units)
        if card.name == "PCOMP":
            return _stack(data, card, units)
    except InputError as error:
        raise error if " (" in str(error).partition(":")[0] else InputError(f"{card}: {error}") from None
    raise InputError(f"{card}: it stands for a shell; allowed: PSHELL, PCOMP")


def _shell(data: BulkData, card: Card, units: Units) -> Laminate:
    middle, bending, shear = card.integer(2, "MID1"), card.integer(4, "MID2", 0), card.integer(6, "MID3", 0)
    if bending != middle or shear not in (0, middle) or card.text(11):
        raise InputError(
            f"{card}: MID1 to MID4 are {[card.text(k) for k in (2, 4, 6, 11)]}; allowed: one material in all"
        )
    if card.real(5, "12I/T**3", 1.0) != 1.0:
        raise InputError(f"{card}: 12I/T**3 is {card.text(5)}; allowed: 1, a solid plate")
    thickness = card.real(3, "T") * units.length
    ply = ply_of(data.material(card, middle), units, data.weight_to_mass)
    ply = _with_extra_mass(ply, card, 8, thickness, data, units)
    laminate = Laminate(ply, [0.0], thickness, shear_correction=card.real(7, "TS/T", 5.0 / 6.0))
    laminate.angles.requires_grad_(False)
    return laminate


def _stack(data: BulkData, card: Card, units: Units) -> Laminate:
    kind = card.text(8).upper()
    if kind not in ("", "SYM"):
        raise InputError(f"{card}: LAM is {kind!r}; allowed: blank, SYM")
    materials, thicknesses, angles = [], [], []
    for start in range(9, len(card.fields) + 1, 4):
        if not any(card.text(start + k) for k in range(3)):
            continue
        materials.append(card.integer(start, "MID", materials[-1] if materials else None))
        thicknesses.append(card.real(start + 1, "T", thicknesses[-1] if thicknesses else None))
        angles.append(card.real(start + 2, "THETA", 0.0))
    if not materials:
        raise InputError(f"{card}: it has no plies")
    total = sum(thicknesses) * (2.0 if kind == "SYM" else 1.0)
    if abs(card.real(2, "Z0", -total / 2.0) + total / 2.0) > 1e-4 * total:
        raise InputError(
            f"{card}: Z0 is {card.text(2)}; allowed: blank or {-total / 2.0:g}, the laminate about its middle"
        )
    plies = [ply_of(data.material(card, number), units, data.weight_to_mass) for number in materials]
    plies = [_with_extra_mass(ply, card, 3, total * units.length, data, units) for ply in plies]
    thicknesses = [t * units.length for t in thicknesses]
    return Laminate(plies, deg(angles), thicknesses, symmetric=kind == "SYM", shear_correction="energy")


def _with_extra_mass(ply: Ply, card: Card, position: int, thickness: float, data: BulkData, units: Units) -> Ply:
    extra = card.real(position, "NSM", 0.0) * units.per_area * data.weight_to_mass
    return dataclasses.replace(ply, density=ply.density + extra / thickness) if extra else ply


def section_of(data: BulkData, card: Card, units: Units) -> BeamSection:
    """Make the beam section of a PBAR, PBARL or PBEAM: plane 1 is x-y, so I1 bends about z."""
    material = data.material(card, card.integer(2, "MID"))
    ply = ply_of(material, units, data.weight_to_mass)
    if material.name != "MAT1":
        raise InputError(f"{card}: {material} is the material of a beam; allowed: MAT1")
    if card.name == "PBARL":
        numbers, extra = _shape(card)
    elif card.name in ("PBAR", "PBEAM"):
        numbers, extra = _given(card)
    else:
        raise InputError(f"{card}: this section cannot be read; allowed: PBAR, PBARL, PBEAM")
    A, I1, I2, J, K1, K2 = numbers
    L = units.length
    density = ply.density + extra * units.mass / L * data.weight_to_mass / (A * L**2)
    return GivenSection.isotropic(ply.E1, ply.nu12, density, A * L**2, I2 * L**4, I1 * L**4, J * L**4, K1, K2)


def _given(card: Card) -> tuple[list[float], float]:
    """A, I1, I2, J, K1, K2 and mass per length without stiffness of a PBAR or PBEAM."""
    beam = card.name == "PBEAM"
    product = 6 if beam else 19
    if card.real(product, "I12", 0.0) != 0.0:
        raise InputError(f"{card}: I12 is {card.text(product)}; allowed: 0, principal axes")
    places = ((3, "A"), (4, "I1"), (5, "I2"), (7, "J")) if beam else ((3, "A"), (4, "I1"), (5, "I2"), (6, "J"))
    numbers = [card.real(k, name) for k, name in places]
    last = _after_stations(card) if beam else 17
    shear = [card.real(last + k, f"K{k + 1}", 1.0 if beam else 0.0) or RIGID_IN_SHEAR for k in (0, 1)]
    return numbers + shear, card.real(8 if beam else 7, "NSM", 0.0)


def _after_stations(card: Card) -> int:
    """The field of K1 of a PBEAM: after end B, if that is given."""
    stations = ("YES", "YESA", "NO")
    last = 33 if card.text(17).upper() in stations else 17
    for k, word in enumerate(card.fields[18:], start=19):
        if k < last:
            right = not word or k > 24 or card.real(k, "end B") == card.real(k - 16, "end A", 0.0)
        else:
            right = word.upper() not in stations and (k < last + 2 or card.real(k, f"field {k}", 0.0) == 0.0)
        if not right:
            allowed = "one station with the numbers of end A, then K1, K2, then zeros"
            raise InputError(f"{card}: field {k} is {word}; allowed: {allowed}")
    return last


def _shape(card: Card) -> tuple[list[float], float]:
    """A, I1, I2, J, K1, K2 and mass per length without stiffness of a PBARL."""
    kind = card.text(4).upper()
    count = {"ROD": 1, "TUBE": 2, "BAR": 2}.get(kind)
    if count is None:
        raise InputError(f"{card}: TYPE is {kind!r}; allowed: ROD, TUBE, BAR")
    d = [card.real(9 + k, f"DIM{k + 1}") for k in range(count)]
    extra = card.real(9 + count, "NSM", 0.0)
    if kind == "BAR":
        width, height = d  # along z and along y (plane 1)
        a, b = max(d) / 2, min(d) / 2
        series = sum(math.tanh(n * math.pi * a / (2 * b)) / n**5 for n in range(1, 40, 2))
        J = a * b**3 * (16 / 3 - 1024 / math.pi**5 * b / a * series)
        return [width * height, width * height**3 / 12, height * width**3 / 12, J, 5 / 6, 5 / 6], extra
    outer, inner = d[0], d[1] if kind == "TUBE" else 0.0
    inertia = math.pi / 4 * (outer**4 - inner**4)
    return [
        math.pi * (outer**2 - inner**2),
        inertia,
        inertia,
        2 * inertia,
        0.9 if kind == "ROD" else 0.5,
        0.9 if kind == "ROD" else 0.5,
    ], extra
