"""Mass without stiffness that a case control chooses: NSM, NSM1, NSML, NSML1, and NSMADD, which adds sets of them.

    NSM, NSM1     mass per area of shells and panels, per length of bars and rods
    NSML, NSML1   a mass that is spread evenly over their whole area or length: of each number (NSML), of all of a card (NSML1)

Elements are named by their property (PSHELL, PBAR, ..., CONROD by its own number) or their own number (ELEMENT). The mass lies
at the corners of the element, in the middle of its laminate or at the ends of the bar, and does not change with the design.
Source: MSC Nastran Quick Reference Guide, section 8. Checked in tests/extensions/nastran/test_nsm.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from torchmbd.errors import InputError, warn, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.control import Control
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.materials import Units
from torchmbd.extensions.nastran.mesh import BulkMesh
from torchmbd.fem.elements import PointMasses

_AREAS = ("PSHELL", "PCOMP", "PSHEAR")


class Carrier(NamedTuple):
    """An element that carries mass: its area or length in units of the file, nodes, and the arm from these to the mass [m]."""

    kind: str
    property: int
    number: int
    measure: float
    nodes: tuple[int, ...]
    arm: tuple[float, float, float]


def extra_masses(
    data: BulkData, bulk: BulkMesh, control: Control | None, units: Units, heights: Mapping[tuple[int, float], float]
) -> PointMasses | None:
    """The masses of the chosen set; None without any. `heights`: middle of the laminate of each zone above its grids [m]."""
    chosen = _chosen(data, control)
    if not chosen:
        return None
    carriers = _carriers(data, bulk, units, heights)
    nodes: list[int] = []
    masses: list[float] = []
    arms: list[tuple[float, float, float]] = []
    for card in chosen:
        for carrier, mass in _shares(card, carriers):
            many = len(carrier.nodes)
            nodes += carrier.nodes
            masses += [mass / many * units.mass * data.weight_to_mass] * many
            arms += [carrier.arm] * many
    return PointMasses(bulk.mesh, nodes, masses, [0.0] * len(nodes), arms if np.any(arms) else None)


def _chosen(data: BulkData, control: Control | None) -> list[Card]:
    """The cards of the set that the case control names; of a file without one the only set."""
    sets: dict[int, list[Card]] = {}
    for card in data.nonstructural:
        sets.setdefault(card.integer(1, "SID"), []).append(card)
    if not sets:
        return []
    unions = {card.integer(1, "SID"): card for card in data.unions if card.name == "NSMADD"}
    parts = {number for card in unions.values() for number in card.integers(2, sets)}
    if control is None:
        names = [str(number) for number in sorted((sets.keys() | unions.keys()) - parts)]
        if len(names) == 1:
            warn(f"torchmbd uses set {names[0]} of NSM, because the file has no case control that chooses a set")
    else:
        names = list(control.chosen.get("NSM", {}))
        if not names:
            data.ignored["NSM that the case control does not choose"] += len(data.nonstructural)
            return []
    if len(names) != 1 or not names[0].isdigit() or int(names[0]) not in (sets.keys() | unions.keys()):
        place = f" ({next(iter(control.chosen['NSM'].values()))})" if control else ""
        raise InputError(
            "NSM",
            ", ".join(names),
            f"one set of {sorted(sets.keys() | unions.keys())} in the case control",
            shown=f"{', '.join(names)}{place}",
        )
    number = int(names[0])
    if number not in unions:
        return sets[number]
    missing = [part for part in unions[number].integers(2, sets) if part not in sets]
    if missing or number in sets:
        raise wrong_entry(unions[number], f"sets {missing or [number]}", "sets of NSM that exist, with another number")
    return [card for part in dict.fromkeys(unions[number].integers(2, sets)) for card in sets[part]]


def _carriers(
    data: BulkData, bulk: BulkMesh, units: Units, heights: Mapping[tuple[int, float], float]
) -> list[Carrier]:
    none, carriers = (0.0, 0.0, 0.0), []
    for cell, kind, height in (
        *((x, data.properties[x.property].name, heights[x.property, x.offset]) for x in data.shells),
        *((x, "PSHEAR", 0.0) for x in data.panels),
    ):
        x = np.array([data.grids[grid] for grid in cell.grids])
        normal = 0.5 * np.cross(x[2] - x[0], x[-1 if len(x) == 4 else 2] - x[1])
        area = float(np.linalg.norm(normal))
        arm = tuple((normal / area * height).tolist()) if height else none
        nodes = tuple(bulk.index[grid] for grid in cell.grids)
        carriers.append(Carrier(kind, cell.property, cell.card.integer(1, "EID"), area, nodes, arm))
    places = bulk.mesh.nodes.detach().numpy()
    for bar, nodes, offset in zip(data.bars, bulk.bars.nodes, bulk.bars.offset, strict=True):
        length = float(np.linalg.norm(places[nodes[1]] - places[nodes[0]])) / units.length
        kind, arm = data.properties[bar.property].name, tuple((offset * units.length).tolist())
        carriers.append(Carrier(kind, bar.property, bar.card.integer(1, "EID"), length, nodes, arm))
    for link in data.links:
        kind = {"CROD": "PROD", "CTUBE": "PTUBE", "CONROD": "CONROD"}.get(link.card.name)
        if kind is not None:
            a, b = (np.array(data.grids[grid]) for grid in link.grids)
            number, nodes = link.card.integer(1, "EID"), tuple(bulk.index[grid] for grid in link.grids)
            carriers.append(Carrier(kind, link.property or number, number, float(np.linalg.norm(b - a)), nodes, none))
    return [x._replace(kind="PCOMP" if x.kind == "PCOMPG" else x.kind) for x in carriers]


def _shares(card: Card, carriers: list[Carrier]) -> Iterator[tuple[Carrier, float]]:
    """Elements of a card, and the mass of each in units of the file."""
    kind = card.text(2).upper()
    kind = "PCOMP" if kind == "PCOMPG" else kind
    by_number: dict[int, list[Carrier]] = {}
    for carrier in carriers:
        if kind in ("ELEMENT", carrier.kind):
            by_number.setdefault(carrier.number if kind == "ELEMENT" else carrier.property, []).append(carrier)
    if card.name in ("NSM1", "NSML1"):
        every = [word for word in card.fields[3:] if word] == ["ALL"]
        groups = [(list(by_number) if every else card.integers(4, by_number), card.real(3, "VALUE"))]
    else:
        pairs = range(3, len(card.fields) + 1, 2)
        groups = [([card.integer(k, "ID")], card.real(k + 1, "VALUE")) for k in pairs if card.text(k)]
    for numbers, value in groups:
        missing = [number for number in numbers if number not in by_number]
        if missing or not numbers or value < 0.0:
            raise wrong_entry(
                card,
                f"TYPE {kind}, ID {missing or numbers}, VALUE {value:g}",
                f"numbers of {kind} with shells, panels, bars or rods, a value >= 0",
                key="ID",
            )
        members = [carrier for number in dict.fromkeys(numbers) for carrier in by_number[number]]
        if card.name in ("NSML", "NSML1"):
            if len({carrier.kind in _AREAS for carrier in members}) > 1:
                raise wrong_entry(
                    card, "its mass is spread over areas and lengths", "spread over either areas or lengths", key="ID"
                )
            value = value / sum(carrier.measure for carrier in members)
        for carrier in members:
            yield carrier, value * carrier.measure
