"""Cards of rods, springs, bushings, solids and bars that are rigid, as numbers.

    CROD, CTUBE, CONROD, CELAS1, CELAS2, CBUSH   two grids       CTETRA, CPENTA, CHEXA   4, 6, 8 grids, without nodes on sides

Source: MSC Nastran Quick Reference Guide, section 8. Checked in tests/io/nastran/test_elements.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from torchmbd.errors import InputError
from torchmbd.io.nastran.cards import Card

SOLIDS = {"CTETRA": 4, "CPENTA": 6, "CHEXA": 8}
#: name -> (position of the first grid, of the second grid, property card or "")
LINKS = {
    "CROD": (3, 4, "PROD"),
    "CONROD": (2, 3, ""),
    "CTUBE": (3, 4, "PTUBE"),
    "CELAS1": (3, 5, "PELAS"),
    "CELAS2": (3, 5, ""),
    "CBUSH": (3, 4, "PBUSH"),
}
OWN_PROPERTIES = ("PROD", "PTUBE", "PELAS", "PBUSH", "PSOLID")


@dataclass(frozen=True)
class Solid:
    """A CTETRA, CPENTA or CHEXA of corners only."""

    card: Card
    property: int
    grids: tuple[int, ...]


@dataclass(frozen=True)
class Link:
    """A rod, spring or bushing between two grids; `data` of it stands on the card."""

    card: Card
    property: int | None
    grids: tuple[int, int]


def solid(card: Card) -> Solid:
    """Read a solid. InputError where it has nodes on its sides."""
    corners = SOLIDS[card.name]
    if any(card.fields[2 + corners :]):
        raise InputError(f"{card}: it has nodes on its sides; allowed: {corners} corners, a linear solid")
    grids = tuple(card.integer(3 + k, f"G{k + 1}") for k in range(corners))
    if len(set(grids)) < corners:
        raise InputError(f"{card}: grids {list(grids)}; allowed: {corners} different ones")
    return Solid(card, card.integer(2, "PID", card.integer(1, "EID")), grids)


def link(card: Card) -> Link:
    """Read a rod, spring or bushing. InputError where it is held by the ground."""
    first, second, kind = LINKS[card.name]
    grids = card.integer(first, "G1", 0), card.integer(second, "G2", 0)
    if not all(grids):
        raise InputError(f"{card}: one of its ends is the ground; allowed: two grids, a body carries no supports")
    return Link(card, card.integer(2, "PID", card.integer(1, "EID")) if kind else None, grids)


def bar_that_is_rigid(card: Card) -> tuple[int, int]:
    """Leader and follower of an RBAR."""
    names = ("CNA", "CNB", "CMA", "CMB")
    own = {name: set(card.text(4 + k)) - {"0"} for k, name in enumerate(names)}
    whole = set("123456")
    if own["CNA"] == whole and not own["CNB"] and own["CMB"] in (set(), whole):
        return card.integer(2, "GA"), card.integer(3, "GB")
    if own["CNB"] == whole and not own["CNA"] and own["CMA"] in (set(), whole):
        return card.integer(3, "GB"), card.integer(2, "GA")
    given = [card.text(4 + k) for k in range(4)]
    raise InputError(f"{card}: CNA to CMB are {given}; allowed: 123456 at one end, blank at the other")
