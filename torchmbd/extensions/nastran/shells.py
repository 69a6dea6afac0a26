"""Laminates from the property cards of shells in a Nastran model.

    PCOMP(G)   -> Laminate, its angles design parameters; LAM = SYM is a symmetric one; transverse shear stiffness of
                  equal energy, which is right for sandwiches, too
    PSHELL     -> Laminate of one ply; its angle is not a design parameter. Where MID1, MID2 and MID3 differ, are MAT2, or
                  12I/T**3 is not 1, a DividedLaminate, which has no plies

If all materials of a property are MAT1, its angles are constants without a name, because they have no effect.
The middle lies at Z0 + h/2 above the plane of the grids, and ZOFFS of an element more; it stays there where thicknesses are
design variables. Mass without stiffness (NSM) is spread over the thickness. A PSHELL without MID2 is a membrane in Nastran,
whose plate degrees of freedom are held: here it keeps MEMBRANE of the bending stiffness of a solid shell, with a warning.
Checked in tests/extensions/nastran/test_shells.py, tests/extensions/nastran/test_read_bdf.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from torchmbd.errors import InputError, warn, within, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.divided_laminate import DividedLaminate
from torchmbd.extensions.nastran.materials import Units, density_of, ply_of
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.math.angles import deg

MEMBRANE = 1e-6
_SHEAR = 5.0 / 6.0


def laminate_of(data: BulkData, card: Card, units: Units, offset: float = 0.0) -> Laminate:
    """Make the laminate of a PSHELL or PCOMP; offset: of its middle from where the property puts it [m]."""
    try:
        if card.name == "PSHELL":
            return _shell(data, card, units, offset)
        if card.name in ("PCOMP", "PCOMPG"):
            return _stack(data, card, units, offset)
    except InputError as error:
        raise error if any(" (" in str(key) for key in error.path) else within(card, error) from None
    raise wrong_entry(card, "it stands for a shell", "PSHELL, PCOMP or PCOMPG")


def _shell(data: BulkData, card: Card, units: Units, offset: float) -> Laminate:
    middle, bending, shear = card.integer(2, "MID1", 0), card.integer(4, "MID2", 0), card.integer(6, "MID3", 0)
    if middle < 1 or bending < 0 or card.text(11):
        texts = [card.text(k) for k in (2, 4, 6, 11)]
        raise wrong_entry(card, f"MID1 to MID4 are {texts}", "must have MID1 and MID2 >= 0, and no MID4", key="MID1")
    thickness = card.real(3, "T") * units.length
    solid, ratio = card.real(5, "12I/T**3", 1.0), card.real(7, "TS/T", _SHEAR)
    material = data.material(card, middle)
    if bending == middle and shear in (0, middle) and solid == 1.0 and material.name != "MAT2":
        ply = _with_extra_mass(ply_of(material, units, data.weight_to_mass), card, 8, thickness, data, units)
        laminate = Laminate(ply, [0.0], thickness, shear_correction=ratio, offset=offset)
    else:
        if not bending:
            warn(
                f"{card}: MID2 is blank, so the shell is a membrane; torchmbd gives it {MEMBRANE:g} of the bending stiffness "
                "of a homogeneous shell"
            )
        Q = _plane_stiffness(material, units, data)
        Q_bent = solid * _plane_stiffness(data.material(card, bending), units, data) if bending else MEMBRANE * Q
        G = ratio * _shear_stiffness(data.material(card, shear or bending or middle), units, data)
        ply = _with_extra_mass(_equivalent(material, Q, units, data), card, 8, thickness, data, units)
        ply = dataclasses.replace(ply, alpha1=None, alpha2=None)  # its expansion is not that of one material
        laminate = DividedLaminate(ply, thickness, Q, Q_bent, G, offset)
    laminate.angles.requires_grad_(False)
    return _directed(laminate, [data.material(card, number) for number in (middle, bending, shear) if number])


def _directed(laminate: Laminate, materials: Sequence[Card]) -> Laminate:
    """The laminate, whose angles become constants if all materials are isotropic: as design variables they had no effect."""
    if all(material.name == "MAT1" for material in materials):
        angles = laminate.angles.detach()
        del laminate.angles
        laminate.register_buffer("angles", angles, persistent=False)
    return laminate


def _plane_stiffness(material: Card, units: Units, data: BulkData) -> Tensor:
    """Stiffness of plane stress [3, 3] [Pa]."""
    if material.name != "MAT2":
        return _ply_without_density(material, units, data).plane_stiffness()
    g = [
        material.real(2 + k, f"G{name}", 0.0) * units.stress
        for k, name in enumerate(("11", "12", "13", "22", "23", "33"))
    ]
    rows = [[g[0], g[1], g[2]], [g[1], g[3], g[4]], [g[2], g[4], g[5]]]
    return torch.tensor(rows, dtype=torch.float64)


def _shear_stiffness(material: Card, units: Units, data: BulkData) -> Tensor:
    """Stiffness of transverse shear [2, 2] [Pa]; of a MAT2 its G11, G12, G22, or, where it is that of the plane, G33."""
    if material.name != "MAT2":
        return _ply_without_density(material, units, data).shear_stiffness()
    plane = _plane_stiffness(material, units, data)
    return plane[:2, :2] if float(plane[2, 2]) == 0.0 else plane[2, 2] * torch.eye(2, dtype=torch.float64)


def _ply_without_density(material: Card, units: Units, data: BulkData) -> Ply:
    """Return the ply of a material, with density 1 where it has none: only its stiffness is used."""
    place = 5 if material.name == "MAT1" else 8
    fields = [*material.fields, *[""] * (place - len(material.fields))]
    fields[place - 1] = fields[place - 1] if material.real(place, "RHO", 0.0) > 0.0 else "1."
    return ply_of(Card(material.name, tuple(fields), material.where), units, data.weight_to_mass)


def _equivalent(material: Card, Q: Tensor, units: Units, data: BulkData) -> Ply:
    """Return an orthotropic ply that approximates the material, of its density."""
    if material.name != "MAT2":
        return ply_of(material, units, data.weight_to_mass)
    if not float(torch.linalg.eigvalsh(Q)[0]) > 0.0:
        raise wrong_entry(material, f"G11 to G33 are {Q.tolist()}", "a positive definite matrix", key="G")
    S = torch.linalg.inv(Q)
    E1, E2, G12, nu12 = (float(x) for x in (1 / S[0, 0], 1 / S[1, 1], 1 / S[2, 2], -S[0, 1] / S[0, 0]))
    return Ply(E1, E2, G12, G12, G12, nu12, density_of(material, 8, units, data.weight_to_mass))


def _stack(data: BulkData, card: Card, units: Units, offset: float) -> Laminate:
    kind = card.text(8).upper()
    if kind not in ("", "SYM"):
        raise InputError((str(card), "LAM"), kind, "blank or SYM", noun=f"{card}: LAM")
    materials, thicknesses, angles = [], [], []
    for start in ply_places(card):
        materials.append(card.integer(start, "MID", materials[-1] if materials else None))
        thicknesses.append(card.real(start + 1, "T", thicknesses[-1] if thicknesses else None))
        angles.append(card.real(start + 2, "THETA", 0.0))
    if not materials:
        raise wrong_entry(card, "it has no plies", "must have at least one")
    total = sum(thicknesses) * (2.0 if kind == "SYM" else 1.0)
    if not is_centered(card, total):
        offset = offset + (card.real(2, "Z0") + total / 2.0) * units.length
    cards = [data.material(card, number) for number in materials]
    plies = [ply_of(material, units, data.weight_to_mass) for material in cards]
    plies = [_with_extra_mass(ply, card, 3, total * units.length, data, units) for ply in plies]
    thicknesses = [t * units.length for t in thicknesses]
    symmetric = kind == "SYM"
    laminate = Laminate(plies, deg(angles), thicknesses, symmetric=symmetric, shear_correction="energy", offset=offset)
    return _directed(laminate, cards)


def ply_places(card: Card) -> list[int]:
    """Positions of MID, before T and THETA, of the plies of a PCOMP or PCOMPG; SOUT alone makes a ply, too."""
    first, step = (10, 8) if card.name == "PCOMPG" else (9, 4)  # a PCOMPG has a line for each ply, its number before
    starts = range(first, len(card.fields) + 1, step)
    return [start for start in starts if any(card.text(start + k) for k in range(4))]


def is_centered(card: Card, total: float) -> bool:
    """True if the middle of a PCOMP of `total` thickness lies in the plane of the grids, to the few digits that Z0 has."""
    return abs(card.real(2, "Z0", -total / 2.0) + total / 2.0) <= 1e-4 * total


def _with_extra_mass(ply: Ply, card: Card, position: int, thickness: float, data: BulkData, units: Units) -> Ply:
    if not thickness > 0.0:
        raise wrong_entry(card, f"its thickness is {thickness:g} m", "above 0", key="T")
    extra = card.real(position, "NSM", 0.0) * units.per_area * data.weight_to_mass
    return dataclasses.replace(ply, density=ply.density + extra / thickness) if extra else ply
