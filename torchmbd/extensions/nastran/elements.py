"""Cards of rods, springs, bushings, solids and bars that are rigid, as numbers.

    CROD, CTUBE, CONROD, CELAS1, CELAS2, CBUSH   two grids       CTETRA, CPENTA, CHEXA   4, 6, 8 or 10, 15, 20 grids

Source: MSC Nastran Quick Reference Guide, section 8. Checked in tests/extensions/nastran/test_elements.py.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from torchmbd.errors import wrong_entry
from torchmbd.extensions.nastran.card import Card

SOLIDS = {"CTETRA": (4, 10), "CPENTA": (6, 15), "CHEXA": (8, 20)}  # corners, and these with nodes on all sides
#: name -> (position of the first grid, of the second grid, property card or "")
LINKS = {
    "CROD": (3, 4, "PROD"),
    "CONROD": (2, 3, ""),
    "CTUBE": (3, 4, "PTUBE"),
    "CELAS1": (3, 5, "PELAS"),
    "CELAS2": (3, 5, ""),
    "CBUSH": (3, 4, "PBUSH"),
}
SCALAR_MASSES = {"CMASS1": (3, 5, ""), "CMASS2": (3, 5, "")}
OF_SCALARS = ("CELAS3", "CELAS4", "CMASS3", "CMASS4")  # join scalar points and the ground alone
OTHER_PROPERTIES = ("PROD", "PTUBE", "PELAS", "PBUSH", "PSOLID", "PSHEAR")


class ScalarPoints:
    """Numbers of SPOINT and EPOINT: degrees of freedom without a position, which no element of a body joins."""

    def __init__(self, cards: list[Card]) -> None:
        ranges: list[tuple[int, int]] = []
        for card in cards:
            words, k = [word for word in card.fields if word], 0
            while k < len(words):
                last = k + 2 if k + 2 < len(words) and words[k + 1].upper() == "THRU" else k
                start, end = (Card(card.name, (words[i],), card.where).integer(1, "ID") for i in (k, last))
                ranges.append((start, end))
                k = last + 1
        self._starts: list[int] = []
        self._ends: list[int] = []
        for start, end in sorted(ranges):
            if not self._ends or start > self._ends[-1] + 1:
                self._starts.append(start)
                self._ends.append(end)
            self._ends[-1] = max(self._ends[-1], end)

    def __contains__(self, number: int) -> bool:
        k = bisect_right(self._starts, number) - 1
        return k >= 0 and number <= self._ends[k]


@dataclass(frozen=True)
class Solid:
    """A CTETRA, CPENTA or CHEXA of corners, or with the nodes on its sides; or a CSHEAR."""

    card: Card
    property: int
    grids: tuple[int, ...]


@dataclass(frozen=True)
class Link:
    """A rod, spring or bushing between two grids; `data` of it stands on the card."""

    card: Card
    property: int | None
    grids: tuple[int, int]


def read_solid(card: Card) -> Solid:
    """Read a solid. InputError if some of the nodes on its sides are missing."""
    corners, nodes = SOLIDS[card.name]
    count = sum(1 for word in card.fields[2 : nodes + 2] if word not in ("", "0"))
    if count not in (corners, nodes):
        allowed = f"must have {corners} corners alone, or with all {nodes - corners} nodes on its sides"
        raise wrong_entry(card, f"it has {count} grids", allowed, key="G")
    grids = tuple(card.integer(3 + k, f"G{k + 1}") for k in range(count))
    if len(set(grids)) < count:
        raise wrong_entry(card, f"grids {list(grids)}", f"{count} different grids", key="G")
    return Solid(card, card.integer(2, "PID", card.integer(1, "EID")), grids)


def read_panel(card: Card) -> Solid:
    """Read a CSHEAR."""
    grids = tuple(card.integer(3 + k, f"G{k + 1}") for k in range(4))
    if len(set(grids)) < 4:
        raise wrong_entry(card, f"grids {list(grids)}", "4 different grids", key="G")
    return Solid(card, card.integer(2, "PID", card.integer(1, "EID")), grids)


def end_points(card: Card) -> tuple[int, int]:
    """Return the numbers of the points that a rod, spring, bushing or scalar mass joins; 0: the ground."""
    first, second, _ = (LINKS | SCALAR_MASSES)[card.name]
    return card.integer(first, "G1", 0), card.integer(second, "G2", 0)


def read_link(card: Card) -> Link:
    """Read a rod, spring or bushing between two grids."""
    kind, grids = LINKS[card.name][2], end_points(card)
    return Link(card, card.integer(2, "PID", card.integer(1, "EID")) if kind else None, grids)


def rbar_grids(card: Card) -> tuple[int, int]:
    """Return leader and follower of an RBAR."""
    names = ("CNA", "CNB", "CMA", "CMB")
    components = {name: set(card.text(4 + k)) - {"0"} for k, name in enumerate(names)}
    whole = set("123456")
    if components["CNA"] == whole and not components["CNB"] and components["CMB"] in (set(), whole):
        return card.integer(2, "GA"), card.integer(3, "GB")
    if components["CNB"] == whole and not components["CNA"] and components["CMA"] in (set(), whole):
        return card.integer(3, "GB"), card.integer(2, "GA")
    texts = [card.text(4 + k) for k in range(4)]
    raise wrong_entry(card, f"CNA to CMB are {texts}", "123456 at one end, blank at the other", key="CNA")
