"""A Nastran model as numbers: what the cards say, sorted by kind, with the card kept for messages.

    BulkData.of(cards)      grids, shells, bars, properties, materials, masses, rigid elements, MPC, supports

Refused by card and line: a card that is neither read nor known to be no structure (inert.py), a duplicate, a property or
material or grid that does not exist, a field that is missing. Loads and the like are left out; `ignored` counts them.
Elements of scalar points (SPOINT) alone, and springs to the ground, are not part of a body: they are left out, and listed.
Source: MSC Nastran Quick Reference Guide, section 8.
Checked in tests/extensions/nastran/test_data.py.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from torchmbd.errors import InputError, warn, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.elements import (
    LINKS,
    OF_SCALARS,
    OTHER_PROPERTIES,
    SCALAR_MASSES,
    SOLIDS,
    Link,
    ScalarPoints,
    Solid,
    end_points,
    read_link,
    read_panel,
    read_solid,
)
from torchmbd.extensions.nastran.inert import QUIET, is_inert
from torchmbd.extensions.nastran.rigids import RIGIDS, MultipointConstraint, Rigid, read_constraint, read_rigid
from torchmbd.extensions.nastran.systems import KINDS, Systems

SHELLS = {"CTRIA3": 3, "CQUAD4": 4, "CTRIAR": 3, "CQUADR": 4}  # all have drilling freedoms here
BARS = ("CBAR", "CBEAM")
PROPERTIES = ("PSHELL", "PCOMP", "PCOMPG", "PBAR", "PBARL", "PBEAM", "PBEAML")
MATERIALS = re.compile(r"^MAT([12389]|10)$")
THERMAL = re.compile(r"MATT\d+")  # materials that depend on temperature
READ = (
    *SHELLS,
    *BARS,
    *LINKS,
    *SOLIDS,
    "CSHEAR",
    "CONM2",
    *RIGIDS,
    "MPC",
    "SPC",
    "SPC1",
    "NSM",
    "NSM1",
    "NSML",
    "NSML1",
    "MAT1",
    "MAT2",
    "MAT8",
    "MAT9",
)
NONSTRUCTURAL = ("NSM", "NSM1", "NSML", "NSML1")
UNIONS = ("SPCADD", "MPCADD", "NSMADD")
#: Parameters that multiply a matrix of the structure: they may be 1.
FACTORS = {"CK1": "the stiffness", "CM1": "the mass"}


@dataclass(frozen=True)
class Shell:
    """A triangle or quadrilateral: grids, and the angle from its first side [deg] or the system of the material's x axis."""

    card: Card
    property: int
    grids: tuple[int, ...]
    theta: float | None
    system: int | None
    offset: float = 0.0  # of the middle from the plane of the grids, along the normal


@dataclass(frozen=True)
class Bar:
    """A CBAR or CBEAM; `data` keeps the card's fields for orientation and offsets."""

    card: Card
    property: int
    grids: tuple[int, int]


@dataclass(frozen=True)
class Mass:
    """A CONM2: mass and mean rotary inertia at a grid."""

    card: Card
    grid: int
    mass: float
    rotary: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the system `system`
    system: int = 0


@dataclass(frozen=True)
class Support:
    """An SPC1 or SPC, or what a GRID holds itself (set 0): held components of grids."""

    card: Card
    set: int
    components: str
    grids: tuple[int, ...]


@dataclass
class BulkData:
    """The model; dictionaries go by Nastran's numbers."""

    grids: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    grid_cards: dict[int, Card] = field(default_factory=dict)
    shells: list[Shell] = field(default_factory=list)
    bars: list[Bar] = field(default_factory=list)
    solids: list[Solid] = field(default_factory=list)
    panels: list[Solid] = field(default_factory=list)
    links: list[Link] = field(default_factory=list)
    grounded: list[Card] = field(default_factory=list)
    scalars: ScalarPoints = field(default_factory=lambda: ScalarPoints([]))
    other_properties: dict[tuple[str, int], Card] = field(default_factory=dict)
    properties: dict[int, Card] = field(default_factory=dict)
    materials: dict[int, Card] = field(default_factory=dict)
    masses: list[Mass] = field(default_factory=list)
    rigids: list[Rigid] = field(default_factory=list)
    constraints: list[MultipointConstraint] = field(default_factory=list)
    supports: list[Support] = field(default_factory=list)
    nonstructural: list[Card] = field(default_factory=list)
    unions: list[Card] = field(default_factory=list)
    thermal: list[Card] = field(default_factory=list)
    matrices: dict[str, Card] = field(default_factory=dict)
    systems: Systems = field(default_factory=Systems)
    weight_to_mass: float = 1.0
    ignored: Counter[str] = field(default_factory=Counter)

    @classmethod
    def of(cls, cards: list[Card]) -> BulkData:
        """Sort cards and check that everything they name exists."""
        data = cls()
        common = next((card for card in cards if card.name == "GRDSET"), None)
        placed = [_with_defaults(card, common) for card in cards if card.name == "GRID"]
        data.scalars = ScalarPoints([card for card in cards if card.name in ("SPOINT", "EPOINT")])
        data.systems = Systems([card for card in cards if card.name in KINDS], placed)
        for card in placed:
            number = card.integer(1, "ID")
            if number in data.grids:
                raise wrong_entry(
                    card, f"GRID {number} appears twice, first at {data.grid_cards[number].where}", key="ID"
                )
            data.grids[number], data.grid_cards[number] = data.systems.position(card), card
            if card.text(7):
                data.supports.append(Support(card, 0, card.text(7), (number,)))
        for card in cards:
            if card.name not in ("GRID", "GRDSET") and card.name not in KINDS:
                data._sort_card(card)
        data._check()
        for name, numbers in (
            ("SPC", {support.set for support in data.supports} - {0}),
            ("MPC", {constraint.card.integer(1, "SID") for constraint in data.constraints}),
        ):
            unions = [set(card.integers(2, ())) for card in data.unions if card.name == f"{name}ADD"]
            if len(numbers) > 1 and not any(numbers <= union for union in unions):
                warn(
                    f"{name} sets {sorted(numbers)[:8]} hold together, also those that the case control does not choose"
                )
        return data

    def _sort_card(self, card: Card) -> None:
        name = card.name
        if name in SHELLS:
            self.shells.append(_shell(card, SHELLS[name]))
        elif name in BARS:
            grids = card.integer(3, "GA"), card.integer(4, "GB")
            self.bars.append(Bar(card, card.integer(2, "PID", card.integer(1, "EID")), grids))
        elif name in SOLIDS:
            self.solids.append(read_solid(card))
        elif name == "CSHEAR":
            self.panels.append(read_panel(card))
        elif name in LINKS or name in SCALAR_MASSES:
            self._sort_link(card)
        elif name in OTHER_PROPERTIES:
            for part in _split_pelas(card):
                key = (name, part.integer(1, "PID"))
                if key in self.other_properties:
                    raise wrong_entry(part, f"the number {key[1]} is taken by {self.other_properties[key]}", key="PID")
                self.other_properties[key] = part
        elif name in RIGIDS:
            self.rigids.append(read_rigid(card, self.grids))
        elif name == "MPC":
            self.constraints.append(read_constraint(card))
        elif name in PROPERTIES or MATERIALS.match(name):
            table = self.properties if name in PROPERTIES else self.materials
            number = card.integer(1, "number")
            if number in table:
                raise wrong_entry(card, f"the number {number} is taken by {table[number]}", key="ID")
            table[number] = card
        elif name == "CONM2":
            self.masses.append(_mass(card))
        elif name in ("SPC1", "SPC"):
            self.supports.extend(_supports(card, self.grids))
            if name == "SPC" and any(card.real(k, "D", 0.0) for k in (4, 7)):
                self.ignored["enforced displacement of SPC"] += 1
        elif name in NONSTRUCTURAL:
            self.nonstructural.append(card)
        elif name in UNIONS:
            self.unions.append(card)
        elif name == "PARAM":
            self._read_parameter(card)
        elif name in OF_SCALARS:
            self.ignored[f"{name} of scalar points"] += 1
        elif THERMAL.fullmatch(name):
            self.thermal.append(card)
        elif name == "DMIG":
            self.matrices.setdefault(card.text(1).upper(), card)
        elif not is_inert(name):
            raise wrong_entry(
                card,
                "this card cannot be read, and without it the structure may be another",
                f"one of {', '.join(READ)}, or a card without mass, stiffness and support",
            )
        elif name not in QUIET:
            self.ignored[name] += 1

    def _read_parameter(self, card: Card) -> None:
        """Read WTMASS. InputError for other parameters that multiply the matrices of the structure."""
        name = card.text(1).upper()
        if name == "WTMASS":
            self.weight_to_mass = card.real(2, name)
            if not self.weight_to_mass > 0.0:
                raise InputError((str(card), "WTMASS"), card.text(2), "above 0", noun=f"{card}: WTMASS")
        elif name == "K6ROT":
            self.ignored["PARAM K6ROT, as drilling degrees of freedom have the stiffness of the membrane"] += 1
        elif name in FACTORS and card.real(2, name) != 1.0:
            raise InputError(
                (str(card), name),
                card.text(2),
                "1.0",
                noun=f"{card}: {name}",
                state=f"is {card.text(2)}, but read_bdf does not apply this factor, which multiplies {FACTORS[name]}",
            )

    def _sort_link(self, card: Card) -> None:
        """Sort an element between two points: kept between grids, left out between scalar points or at the ground."""
        points = end_points(card)
        of_grids = [number for number in points if number and number not in self.scalars]
        if not of_grids and any(points):
            self.ignored[f"{card.name} of scalar points"] += 1
        elif len(of_grids) == 1 and all(points):
            allowed = "must join two grids, or scalar points alone"
            raise wrong_entry(card, f"it joins grid {of_grids[0]} with a scalar point", allowed, key="G1")
        elif card.name in SCALAR_MASSES:
            raise wrong_entry(card, f"a mass of single components at grids {of_grids}", "a CONM2", key="C1")
        elif card.name not in ("CROD", "CONROD", "CTUBE") and len(of_grids) == 1:
            self._check_grids(card, tuple(of_grids))
            self.grounded.append(card)
        else:
            self.links.append(read_link(card))

    def _check(self) -> None:
        for element in (*self.shells, *self.bars):
            if element.property not in self.properties:
                raise wrong_entry(
                    element.card,
                    f"property {element.property} does not exist",
                    hint="the card of this property",
                    key="PID",
                )
            self._check_grids(element.card, element.grids)
        for element in (*self.solids, *self.panels, *self.links):
            self._check_grids(element.card, element.grids)
        for tied in (*self.rigids, *self.constraints):
            self._check_grids(tied.card, tied.grids)
        for mass in self.masses:
            self._check_grids(mass.card, (mass.grid,))
        for support in self.supports:
            self._check_grids(support.card, tuple(grid for grid in support.grids if grid not in self.scalars))
            if not set(support.components) <= set("0123456"):
                raise wrong_entry(
                    support.card, f"it holds {support.components!r}", "components 1 to 6, as in 123", key="C"
                )
        taken: dict[tuple[str, int], Card] = {}
        for entry in (*self.shells, *self.bars, *self.solids, *self.panels, *self.links, *self.masses, *self.rigids):
            kind = "" if isinstance(entry, (Shell, Bar)) else entry.card.name
            if (first := taken.setdefault((kind, entry.card.integer(1, "EID")), entry.card)) is not entry.card:
                raise wrong_entry(entry.card, f"its number appears twice, first in {first}", key="ID")

    def _check_grids(self, card: Card, grids: tuple[int, ...]) -> None:
        for grid in grids:
            if grid in self.scalars:
                raise InputError(
                    (str(card), str(grid)), allowed="a grid", noun=f"{card}: {grid}", state="is a scalar point"
                )
            if grid not in self.grids:
                raise wrong_entry(card, f"GRID {grid} does not exist", key="G")

    def displacement_axes(self, grid: int) -> np.ndarray:
        """Return the axes of the system CD of a grid at its position, as rows."""
        card = self.grid_cards[grid]
        return self.systems.axes(card.integer(6, "CD", 0), card, np.array(self.grids[grid]))

    def property_of(self, card: Card, name: str, number: int) -> Card:
        """Return the property card of a rod, spring, bushing, solid or shear panel."""
        if (name, number) not in self.other_properties:
            raise wrong_entry(card, f"{name} {number} does not exist", "the number of a card", key="PID")
        return self.other_properties[name, number]

    def material(self, card: Card, number: int) -> Card:
        """Return the material card that a property names."""
        if number not in self.materials:
            raise wrong_entry(
                card, f"material {number} does not exist", "a MAT1, MAT2, MAT8 or MAT9 of the file", key="MID"
            )
        return self.materials[number]


def _with_defaults(card: Card, common: Card | None) -> Card:
    """Return a GRID whose blank fields CP, CD and PS are those of the GRDSET."""
    if common is None:
        return card
    fields = [*card.fields, *[""] * (7 - len(card.fields))]
    for position in (2, 6, 7):
        fields[position - 1] = fields[position - 1] or common.text(position)
    return Card(card.name, tuple(fields), card.where)


def _split_pelas(card: Card) -> list[Card]:
    """Return the two springs of a PELAS as cards; any other card as it is."""
    if card.name != "PELAS":
        return [card]
    parts = [Card(card.name, card.fields[k : k + 4], card.where) for k in (0, 4)]
    return [part for part in parts if part.text(1)]


def _shell(card: Card, corners: int) -> Shell:
    grids = tuple(card.integer(2 + k, f"G{k}") for k in range(1, corners + 1))
    direction, offset = card.text(3 + corners), card.real(4 + corners, "ZOFFS", 0.0)
    for k in range(11, 11 + corners):
        if card.text(k):
            raise wrong_entry(
                card, f"thickness at a corner is {card.text(k)}", "the thickness of the property", key="T"
            )
    is_system = re.fullmatch(r"\d+", direction) is not None
    theta = None if is_system else card.real(3 + corners, "THETA", 0.0)
    property = card.integer(2, "PID", card.integer(1, "EID"))
    return Shell(card, property, grids, theta, int(direction) if is_system else None, offset)


def _mass(card: Card) -> Mass:
    offsets = [card.real(k, f"X{k - 4}", 0.0) for k in (5, 6, 7)]
    system = card.integer(3, "CID", 0)
    if system < 0:
        raise InputError(
            (str(card), "CID"),
            card.text(3),
            "blank",
            hint="put a grid at this place",
            noun=f"{card}: CID",
            state=f"is {card.text(3)}, X1 to X3 are coordinates",
        )
    principal = [card.real(k, name, 0.0) for k, name in ((9, "I11"), (11, "I22"), (14, "I33"))]
    products = [card.real(k, name, 0.0) for k, name in ((10, "I21"), (12, "I31"), (13, "I32"))]
    if any(products) or max(principal) != min(principal):
        mean = sum(principal) / 3.0
        warn(f"{card}: inertias {principal}, products {products}; torchmbd uses their mean, {mean:g}, about every axis")
    x, y, z = offsets
    return Mass(card, card.integer(2, "G"), card.real(4, "M"), sum(principal) / 3.0, (x, y, z), system)


def _supports(card: Card, grids: Collection[int]) -> list[Support]:
    number = card.integer(1, "SID")
    if card.name == "SPC1":
        return [Support(card, number, card.text(2), tuple(card.integers(3, grids)))]
    supports = []
    for start in (2, 5):
        if card.text(start):
            supports.append(Support(card, number, card.text(start + 1), (card.integer(start, "G"),)))
    return supports
