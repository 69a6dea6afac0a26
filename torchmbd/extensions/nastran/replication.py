"""Cards that repeat the card before them, with other numbers (replication, or duplication, of Nastran's bulk data).

    =        in a field: that of the card before; as the name: another card of its name
    ==       this field and all after it: those of the card before
    *(n)     the number of the card before plus n; *n too
    =(n)     as the name: the line before once more, n times; =n too

    GRID,101,17,1.0,10.5,,17,3456
    =,*(1),=,*(0.2),==              GRID 102 at 1.2
    =(3)                            GRID 103, 104, 105

Only cards of one line are repeated, in which all fields are data.
Source: MSC Nastran Quick Reference Guide, section 8 (format of bulk data entries, replication).
Checked in tests/extensions/nastran/test_replication.py.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from torchmbd.errors import wrong_entry
from torchmbd.extensions.nastran.card import Card

MOST = 1_000_000  # repetitions by one line
_STEP = re.compile(r"\*\(?\s*([^()]+?)\s*\)?")
_COUNT = re.compile(r"=\(?\s*([0-9]+)\s*\)?")


def repeats(fields: Sequence[str]) -> bool:
    """True if fields of a line refer to those of the card before."""
    return any(word[0] in "=*" for word in fields if word)


def count_of(head: str, where: str) -> int | None:
    """How many times the name of a line says that the one before is repeated; None where it is another name."""
    if head[:1] != "=" or head == "=":
        return None
    match = _COUNT.fullmatch(head)
    if not match or not 0 < int(match[1]) <= MOST:
        raise wrong_entry(where, f"{head!r} stands for a name", f"=, or =(n) with n of 1 to {MOST}")
    return int(match[1])


def repeated(before: Card | None, fields: Sequence[str], where: str) -> Card:
    """Return the card that repeats the card `before` with fields of its own."""
    if before is None or len(before.fields) > len(fields):
        text = "no card" if before is None else str(before)
        raise wrong_entry(where, f"it repeats {text}", "must repeat a card of one line above it")
    words = []
    for k, word in enumerate(fields, start=1):
        if word == "==":
            words += before.fields[k - 1 :]
            break
        match = _STEP.fullmatch(word)
        words.append(before.text(k) if word == "=" else _increased(before, k, match[1], where) if match else word)
    return Card(before.name, tuple(words), where)


def _increased(before: Card, position: int, step: str, where: str) -> str:
    """The field of the card before plus a step, as text: whole where the field is."""
    change = Card(before.name, (step,), where)
    if "." not in before.text(position):
        return str(before.integer(position, f"field {position}") + change.integer(1, "the step of *"))
    return repr(before.real(position, f"field {position}") + change.real(1, "the step of *"))
