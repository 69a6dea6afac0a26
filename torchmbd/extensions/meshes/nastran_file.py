"""What a Nastran file (.bdf, .fem, .nas) has besides the mesh that meshio reads of it: refused, where the structure is another.

meshio reads GRID and elements, and nothing else: it takes the numbers of a GRID as they stand, whatever its coordinate system,
follows no INCLUDE, and skips masses, springs, rigid elements and every card that it does not know. Here cards must be among
those that change neither the mesh nor its mass, stiffness or ties. Properties and materials are given to `read_mesh` as
laminates; supports (SPC) are left out, as joints hold a body.
Source: MSC Nastran Quick Reference Guide, section 8. Checked in tests/extensions/meshes/test_mesh_file.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchmbd.errors import InputError
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.cards import read_cards
from torchmbd.extensions.nastran.inert import is_inert

#: Shell elements -> the field of ZOFFS; the one before is THETA or MCID, which meshio takes for a node.
_SHELLS = {"CQUAD4": 8, "CQUADR": 8, "CTRIA3": 7, "CTRIAR": 7}
_SECTIONS = ("PSHELL", "PCOMP", "PCOMPG", "MAT1", "MAT2", "MAT3", "MAT8", "MAT9", "MAT10", "PARAM")
_SUPPORTS = ("SPC", "SPC1", "SPCADD")
_REMEDY = "mbd.io.read_bdf reads it, or says why it cannot"


def check_nastran(path: Path) -> None:
    """InputError if meshio would lose the place of a node, an offset, an element, a mass or a tie."""
    for card in read_cards(path):
        if card.name == "GRID" and card.integer(2, "CP", 0):
            raise _refusal(card, "0, because meshio ignores coordinate systems", "CP", card.text(2))
        if card.name == "GRDSET" and any(card.fields):
            raise _refusal(card, "left out, because meshio ignores defaults of GRID")
        if card.name in _SHELLS and card.real(_SHELLS[card.name], "ZOFFS", 0.0):
            raise _refusal(card, "0, because meshio ignores offsets", "ZOFFS", card.text(_SHELLS[card.name]))
        if card.name in _SHELLS and (theta := card.text(_SHELLS[card.name] - 1)):
            raise _refusal(card, "blank, because meshio takes it for a node", "THETA", theta)
        known = ("GRID", "GRDSET", *_SHELLS, *_SECTIONS, *_SUPPORTS)
        if card.name not in known and not is_inert(card.name):
            raise _refusal(card, "left out, because meshio loses it or a part of it")


def check_counts(path: Path, source: Any) -> None:
    """InputError unless meshio read as many nodes and cells as the file has cards."""
    cards = read_cards(path)
    expected = sum(c.name == "GRID" for c in cards), sum(c.name in _SHELLS for c in cards)
    result = len(source.points), sum(len(block.data) for block in source.cells)
    if result != expected:
        raise InputError(
            "path",
            str(path),
            f"must read {expected[0]} and {expected[1]}, as in the file and in what it includes",
            hint=_REMEDY,
            noun="meshio",
            state=f"reads {result[0]} nodes and {result[1]} cells",
        )


def _refusal(card: Card, allowed: str, field: str = "", text: str = "") -> InputError:
    path = (str(card), field) if field else (str(card),)
    return InputError(path, text, allowed, _REMEDY, noun=f"{card}: {field}" if field else f"{card}:", shown=text)


def is_nastran(path: Path) -> bool:
    """True if the name of a file is that of bulk data."""
    return path.suffix.lower() in (".bdf", ".fem", ".nas")
