"""Beam sections from the property cards of a Nastran model, in SI units. Plane 1 is x-y: I1 bends about z.

    PBAR, PBEAM      numbers as given; K1, K2 blank are rigid in shear (PBAR) or 1 (PBEAM)
    PBARL, PBEAML    closed forms of named sections (shapes.py)

The line of a CBEAM is that of the centers of shear: N1, N2 of a PBEAM, or the shape of a PBEAML, say where the neutral axis
lies. Of a section that changes along the bar the mean is taken (linear between stations), with a warning.
Mass without stiffness (NSM) is spread over the section.
Source: MSC Nastran Quick Reference Guide, section 8.
Checked in tests/extensions/nastran/test_sections.py, tests/extensions/nastran/test_read_bdf.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, warn, within, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.materials import Units, ply_of
from torchmbd.extensions.nastran.shapes import RIGID_IN_SHEAR, SHAPES, SectionNumbers, of_shape
from torchmbd.fem.elements import GivenSection
from torchmbd.fem.elements.beam_section import line_transform
from torchmbd.math.variable import number

STATIONS = ("YES", "YESA", "NO")


def section_of(data: BulkData, card: Card, units: Units) -> GivenSection:
    """Make the section of a bar. InputError names the card and the field."""
    material = data.material(card, card.integer(2, "MID"))
    if material.name != "MAT1":
        raise InputError(
            (str(card), str(material)), allowed="MAT1", noun=f"{card}: {material}", state="is the material of a beam"
        )
    ply = ply_of(material, units, data.weight_to_mass)
    readers = {"PBAR": _bar, "PBARL": _named_bar, "PBEAM": _beam, "PBEAML": _named_beam}
    if card.name not in readers:
        raise wrong_entry(card, "this section cannot be read", f"one of {', '.join(readers)}")
    numbers, extra = readers[card.name](card)
    if not numbers.A > 0.0:
        raise InputError((str(card), "A"), numbers.A, "above 0", noun=f"{card}: A", shown=f"{numbers.A:g}")
    L = units.length
    density = ply.density + extra * units.mass / L * data.weight_to_mass / (numbers.A * L**2)
    try:
        section = _section(numbers, L, number(ply.E1), number(ply.G12), number(density))
    except InputError as error:
        raise within(card, error) from None
    section.alpha = None if ply.alpha1 is None else number(ply.alpha1)
    return section


def _section(numbers: SectionNumbers, length: float, E: float, G: float, density: float) -> GivenSection:
    """Stiffness and mass in meters; axial force and bending act at the neutral axis, shear at the center of shear."""
    A, fourth = numbers.A * length**2, length**4
    I1, I2, I12 = numbers.I1 * fourth, numbers.I2 * fourth, numbers.I12 * fourth
    direct, shear, mass = (torch.zeros(6, 6, dtype=torch.float64) for _ in range(3))
    direct[0, 0] = E * A
    direct[4:, 4:] = E * _second(I1, I2, I12)
    shear.diagonal()[1:4] = torch.tensor(
        [G * A * numbers.K1, G * A * numbers.K2, G * numbers.J * fourth], dtype=torch.float64
    )
    mass.diagonal()[:4] = density * torch.tensor([A, A, A, I1 + I2], dtype=torch.float64)
    mass[4:, 4:] = density * _second(I1, I2, I12)
    at = line_transform(
        length * torch.tensor(numbers.center, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    )
    return GivenSection(at @ direct @ at.T + shear, at @ mass @ at.T)


def _second(I1: float, I2: float, I12: float) -> Float[Tensor, "2 2"]:
    """Moments about y and z of curvatures about them."""
    return torch.tensor([[I2, -I12], [-I12, I1]], dtype=torch.float64)


def _bar(card: Card) -> tuple[SectionNumbers, float]:
    A, I1, I2, J = (card.real(k, name) for k, name in ((3, "A"), (4, "I1"), (5, "I2"), (6, "J")))
    K1, K2 = (card.real(k, name, 0.0) or RIGID_IN_SHEAR for k, name in ((17, "K1"), (18, "K2")))
    return SectionNumbers(A, I1, I2, card.real(19, "I12", 0.0), J, K1, K2), card.real(7, "NSM", 0.0)


def _named_bar(card: Card) -> tuple[SectionNumbers, float]:
    kind = _kind(card, set(SHAPES) - {"L"})
    count = SHAPES[kind]
    numbers = _shape(card, kind, [card.real(9 + k, f"DIM{k + 1}") for k in range(count)])
    # The line of a CBAR is its neutral axis.
    return numbers._replace(center=(0.0, 0.0)), card.real(9 + count, "NSM", 0.0)


def _named_beam(card: Card) -> tuple[SectionNumbers, float]:
    kind = _kind(card, set(SHAPES) - {"BOX1", "HAT"})
    names = [*(f"DIM{k + 1}" for k in range(SHAPES[kind])), "NSM"]
    first = [card.real(9 + k, name, None if name != "NSM" else 0.0) for k, name in enumerate(names)]
    stations, step = {0.0: first}, len(names) + 2
    for start in range(9 + len(names), len(card.fields) + 1, step):
        word = card.text(start).upper()
        if word not in (*STATIONS, ""):
            raise InputError(
                (str(card), "SO"), word, f"one of {', '.join(STATIONS)}, after each station", noun=f"{card}: SO"
            )
        place = _station(card, start + 1)
        stations[place] = [card.real(start + 2 + k, name, first[k]) for k, name in enumerate(names)]
    sections = {
        x: (*_shape(card, kind, station[:-1])._replace(center=(0.0, 0.0))[:7], station[-1])
        for x, station in stations.items()
    }
    centers = [_shape(card, kind, station[:-1]).center for station in stations.values()]
    *numbers, extra = _mean(card, {x: list(section) for x, section in sections.items()})
    if any(center != centers[0] for center in centers):
        warn(f"{card}: its shear center varies along the bar; torchmbd uses the shear center at end A")
    return SectionNumbers(*numbers, center=centers[0]), extra  # pyright: ignore[reportArgumentType]


def _shape(card: Card, kind: str, d: list[float]) -> SectionNumbers:
    try:
        return of_shape(kind, d)
    except ValueError as error:
        raise wrong_entry(card, f"{kind} of {d}", f"must have {error}", key="DIM") from None


def _kind(card: Card, allowed: set[str]) -> str:
    kind = card.text(4).upper()
    if kind not in allowed:
        raise InputError((str(card), "TYPE"), kind, sorted(allowed), noun=f"{card}: TYPE")
    return kind


def _beam(card: Card) -> tuple[SectionNumbers, float]:
    names = ("A", "I1", "I2", "I12", "J", "NSM")
    optional = ("I12", "J", "NSM")
    first = [card.real(3 + k, name, 0.0 if name in optional else None) for k, name in enumerate(names)]
    stations, start = {0.0: first}, 17
    while (word := card.text(start).upper()) in STATIONS:
        place = _station(card, start + 1)
        known = place == 1.0 or all(card.text(start + 2 + k) for k in range(3))
        if known:  # blank numbers between the ends are those of the line between them
            stations[place] = [card.real(start + 2 + k, name, first[k]) for k, name in enumerate(names)]
        start += 8
        # C1 to F2 follow YES only, but many programs write a blank line after NO and YESA.
        if word == "YES" or (not any(card.text(start + k) for k in range(8)) and len(card.fields) > start + 7):
            start += 8
    A, I1, I2, I12, J, extra = _mean(card, stations)
    K1, K2 = (card.real(start + k, f"K{k + 1}", 1.0) or RIGID_IN_SHEAR for k in (0, 1))
    for k, name in ((2, "S1"), (3, "S2"), (4, "NSI(A)"), (5, "NSI(B)"), (6, "CW(A)"), (7, "CW(B)")):
        if card.real(start + k, name, 0.0) != 0.0:
            warn(f"{card}: {name} is {card.text(start + k)}; the reader leaves this out")
    places = [card.real(start + 8 + k, f"field {start + 8 + k}", 0.0) for k in range(8)]
    center = (_mean_of_ends(card, "N1", places[4], places[6]), _mean_of_ends(card, "N2", places[5], places[7]))
    if any(places[:4]) and extra:
        warn(f"{card}: its nonstructural mass lies at M1, M2; torchmbd puts it on the neutral axis")
    if card.text(start + 16):
        raise wrong_entry(card, f"field {start + 16} is {card.text(start + 16)}", "stations, K1 to CW, M1 to N2")
    return SectionNumbers(A, I1, I2, I12, J, K1, K2, center), extra


def _mean_of_ends(card: Card, name: str, start: float, end: float) -> float:
    if start != end and end != 0.0:
        warn(f"{card}: {name} is {start:g} and {end:g} at its ends; torchmbd uses the mean")
        return (start + end) / 2.0
    return start


def _station(card: Card, position: int) -> float:
    place = card.real(position, "X/XB", 1.0)
    if not 0.0 < place <= 1.0:
        raise InputError(
            (str(card), "X/XB"), place, "more than 0 and at most 1", noun=f"{card}: X/XB", shown=f"{place:g}"
        )
    return place


def _mean(card: Card, stations: dict[float, list[float]]) -> list[float]:
    """Return the mean of numbers along the bar, linear between stations; end B is like end A where it is not given."""
    if 1.0 not in stations:
        stations[1.0] = stations[0.0]
    x = torch.tensor(sorted(stations), dtype=torch.float64)
    rows = torch.tensor([stations[place] for place in sorted(stations)], dtype=torch.float64)
    mean = torch.trapezoid(rows, x[:, None].expand_as(rows), dim=0)
    if not torch.allclose(rows, rows[:1].expand_as(rows), rtol=1e-6, atol=0.0):
        warn(
            f"{card}: its section changes along the bar; torchmbd uses the mean, A {mean[0]:g}, I1 {mean[1]:g}, I2 {mean[2]:g}"
        )
    return mean.tolist()
