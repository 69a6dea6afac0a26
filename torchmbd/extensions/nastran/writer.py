"""Ply angles and thicknesses of a design in the deck that its bodies were read from.

    PCOMP, PCOMPG   THETA and T of the plies; Z0 where it is given, so that the middle stays where it was
    PSHELL          T

Only property cards that change are written, in large fields; every other line stays as it is, byte for byte. Lines of INCLUDE
give way to the files that they name, so the deck is one file. A card of which several parts are made (ZOFFS) needs one design
of all. NSM of a card is spread over the thickness and follows it, as in the body.
Checked in tests/extensions/nastran/test_write_bdf.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchmbd.design.flexible_bodies import flexible_bodies
from torchmbd.errors import InputError, warn
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.cards import DeckText, line_kind, parse_cards, read_text
from torchmbd.extensions.nastran.data import PROPERTIES
from torchmbd.extensions.nastran.field_text import WIDTH, card_lines, number_text
from torchmbd.extensions.nastran.materials import units_of
from torchmbd.extensions.nastran.shells import is_centered, ply_places
from torchmbd.fem.materials import Laminate
from torchmbd.math.angles import deg
from torchmbd.multibody.bodies import FlexibleBody

_SAME = 1e-9  # differences of properties and directions that are rounding


@dataclass(frozen=True)
class Source:
    """The deck of a body: digest of its text, name of its units, number of the property card of each laminated part."""

    digest: str
    units: str
    properties: dict[str, int]


class NastranBody(FlexibleBody):
    """A body of a Nastran model, which knows its deck; None: it was made finer since, and its parts are others."""

    derived_state = ("source",)  # it changes no number
    source: Source | None = None


@dataclass(frozen=True, eq=False)
class _Stack:
    """A laminate of a part, with the name of the part and meters per unit of the deck."""

    name: str
    laminate: Laminate
    length: float


def write_bdf(design: Any, deck: str | Path, path: str | Path | None = None) -> Path:
    """Write ply angles and thicknesses of a design into a copy of the deck from which its bodies were read.

    design   result of mbd.optimize or mbd.optimization.multistart, study of mbd.load, System or body; its bodies come from
             read_bdf
    deck     the file that read_bdf has read, unchanged since then; write_bdf does not change it
    path     the file to write, which must not be a file that the deck includes; None: NAME_optimized in the folder of the
             deck
    Cards that do not change keep every byte. Returns the path. Raises InputError if the deck has changed, or if its cards
    cannot hold the design.

    >>> cards = "MAT8,1,128.+9,10.1+9,.23,5.4+9,5.4+9,5.4+9,1586.", "PCOMP,7,,,,,,,SYM", ",1,1.-3,20.,,1,1.-3,70."
    >>> grids = "GRID,1,,0.,0.,0.", "GRID,2,,1.,0.,0.", "GRID,3,,1.,1.,0.", "GRID,4,,0.,1.,0."
    >>> with open("plate.bdf", "w") as file:
    ...     _ = file.write("\\n".join(["BEGIN BULK", *cards, *grids, "CQUAD4,1,7,1,2,3,4,0.", "ENDDATA"]))
    >>> body = mbd.io.read_bdf("plate.bdf", "plate", modes=2)
    >>> with torch.no_grad():
    ...     _ = body.laminate.angles.copy_(mbd.deg([30.0, -60.0]))
    >>> path = mbd.io.write_bdf(body, "plate.bdf")
    >>> torch.rad2deg(mbd.io.read_bdf(path, "plate", modes=2).laminate.angles).round().tolist()
    [30.0, -60.0]
    """
    text = read_text("deck", deck)
    target = Path(path) if path is not None else Path(deck).with_stem(f"{Path(deck).stem}_optimized")
    if target.resolve() in text.paths:
        allowed = "another file than the deck and what it includes, which must keep the contents that were read"
        raise InputError("path", str(target), allowed)
    stacks = _stacks_by_card(flexible_bodies("design", design), text, str(deck))
    changes = {}
    for card in parse_cards(text.bulk_lines()):
        if card.name in PROPERTIES and (members := stacks.get(card.integer(1, "PID"))):
            changes |= _changes(text, card, members)
    with target.open("w", encoding="utf-8", errors="surrogateescape", newline="") as file:
        file.writelines(_written(text.lines, changes))
    return target


def _stacks_by_card(bodies: list[FlexibleBody], text: DeckText, deck: str) -> dict[int, list[_Stack]]:
    """The laminates of the bodies that were read from the deck, by the number of their property."""
    sources = [(body, body.source) for body in bodies if isinstance(body, NastranBody) and body.source is not None]
    members = [(body, source) for body, source in sources if source.digest == text.digest]
    if not members:
        names = ", ".join(repr(body.name) for body, _ in sources)
        unchanged = f"the deck of {names}, with the contents that were read"
        allowed = unchanged if sources else "a deck from which mbd.io.read_bdf made a body of the design"
        raise InputError("deck", deck, allowed)
    stacks: dict[int, list[_Stack]] = {}
    for body, source in members:
        for part, number in source.properties.items():
            laminate = body.plates[part].laminates[0]
            stacks.setdefault(number, []).append(_Stack(f"{body.name}.{part}", laminate, units_of(source.units).length))
    return stacks


def _changes(text: DeckText, card: Card, stacks: list[_Stack]) -> dict[int, list[str]]:
    """Lines of the text that the design of a card replaces: index -> new lines; none where the card stays as it is."""
    fields = [_fields(card, stack) for stack in stacks]
    for stack, others in zip(stacks, fields, strict=True):
        if others != fields[0]:
            raise InputError(
                (card.name, card.fields[0]),
                hint="links of the problem that make their angles and thicknesses equal",
                noun=f"{card.name} {card.fields[0]}",
                allowed="must have the same design in both",
                state=f"is the card of both {stacks[0].name} and {stack.name}",
            )
    if fields[0] == list(card.fields):
        return {}
    first = int(card.where)
    end = "\r\n" if text.lines[first].endswith("\r\n") else "\n"
    indices = [first, *_continuations(text, first, card)]
    return {index: [] for index in indices} | {first: [line + end for line in card_lines(card.name, fields[0])]}


def _continuations(text: DeckText, first: int, card: Card) -> list[int]:
    """Indices of the lines that continue a card. InputError if the card repeats another, or is repeated."""
    indices = []
    for index in range(first, len(text.lines)):
        line = text.lines[index].partition("$")[0].rstrip()
        kind = line_kind(line) if line else "comment"
        if kind == "repetition":
            raise InputError(
                (card.name, card.fields[0]),
                hint="a deck whose cards are written out",
                noun=f"{card.name} {card.fields[0]}",
                allowed="written out, because its numbers change",
                state="repeats another card, or another card repeats it (=)",
            )
        if kind == "card" and index > first:
            break
        if kind == "continuation":
            indices.append(index)
    return indices


def _fields(card: Card, stack: _Stack) -> list[str]:
    """Data fields of the card with the numbers of a laminate; those that did not change are as they were."""
    fields, laminate = list(card.fields), stack.laminate
    angles = laminate.angles.detach()
    several = max((x.shape[0] for x in (angles, laminate.thickness) if x.dim() > 1), default=0)
    if several:
        raise InputError(
            (stack.name,), hint="a single design", allowed="must have one", state=f"has {several} designs at once"
        )
    thickness = laminate.thickness.detach().broadcast_to(angles.shape)
    if card.name == "PSHELL":
        if _direction_matters(laminate):
            turn = math.degrees(float(angles[0]))
            raise InputError(
                (stack.name, "turn"),
                hint="a problem without this angle among its variables, or a PCOMP in the deck",
                noun=f"{stack.name}",
                allowed="0, because a PSHELL has no angle",
                state=f"is turned by {turn:g} degrees",
            )
        places, before = [2], torch.tensor([card.real(3, "T")], dtype=torch.float64)
    else:
        places = ply_places(card)
        old = [card.real(place + 1, "T") if card.text(place + 1) else math.nan for place in places]
        before = torch.tensor(_filled(old), dtype=torch.float64)
        for place, angle in zip(places, angles.tolist(), strict=True):
            if float(deg(card.real(place + 2, "THETA", 0.0))) != angle:
                _put(fields, place + 2, number_text(math.degrees(angle)))
    changed = before * stack.length != thickness
    for place, is_changed, t in zip(places, changed.tolist(), thickness.tolist(), strict=True):
        if is_changed or (bool(changed.any()) and not card.text(place + 1)):
            _put(fields, place + 1, number_text(t / stack.length))
    if bool(changed.any()):
        _follow_thickness(fields, card, stack, before, thickness / stack.length)
    if fields != list(card.fields):
        fields = [x if len(x) <= WIDTH else number_text(Card("", (x,), card.where).real(1, "a field")) for x in fields]
    return fields


def _direction_matters(laminate: Laminate) -> bool:
    """True if the layers of a PSHELL have other properties along their angles than along its x-axis.

    A metal has the same in all directions. Its strengths are kept in directions, by which criteria of failure judge.
    """
    angles = laminate.angles.detach()
    if bool((torch.sin(angles).abs() <= _SAME).all()):  # zero up to rounding, or half a turn
        return False
    if any(p.strength is not None or p.alpha1 != p.alpha2 or p.beta1 != p.beta2 for p in laminate.plies):
        return True
    with torch.no_grad():
        turned, straight = laminate(), torch.func.functional_call(laminate, {"angles": torch.zeros_like(angles)}, ())
    return bool(((turned - straight).abs() > _SAME * straight.abs().max()).any())


def _filled(values: list[float]) -> list[float]:
    """Numbers whose gaps (nan) are filled by the number before."""
    return [next(x for x in values[k::-1] if not math.isnan(x)) for k in range(len(values))]


def _follow_thickness(fields: list[str], card: Card, stack: _Stack, before: Tensor, after: Tensor) -> None:
    """Change Z0, NSM, Z1 and Z2 of a card as the body has them where its thickness changes."""
    of_shell = card.name == "PSHELL"
    ratio = float(after.sum() / before.sum())
    place = 8 if of_shell else 3
    if extra := card.real(place, "NSM", 0.0):
        warn(
            f"{card.name} {card.fields[0]}: NSM is written as {ratio * extra:g} in place of {extra:g}, because the body "
            f"{stack.name} spreads it over the thickness, which changed by the factor {ratio:g}"
        )
        _put(fields, place, number_text(ratio * extra))
    for place in (9, 10):  # Z1, Z2: heights at which stresses are recovered
        if of_shell and card.text(place):
            _put(fields, place, number_text(ratio * card.real(place, "Z1" if place == 9 else "Z2")))
    if not of_shell and card.text(2):
        sides = 2.0 if card.text(8).upper() == "SYM" else 1.0
        old, new = (sides * float(x.sum()) for x in (before, after))
        height = 0.0 if is_centered(card, old) else card.real(2, "Z0") + old / 2.0
        _put(fields, 2, number_text(height - new / 2.0))


def _put(fields: list[str], place: int, text: str) -> None:
    fields.extend([""] * (place - len(fields)))
    fields[place - 1] = text


def _written(lines: list[str], changes: dict[int, list[str]]) -> list[str]:
    """The lines with their changes; each ends, as a line of an included file may not."""
    ended = [
        line if line.endswith(("\n", "\r")) or k == len(lines) - 1 else f"{line}\n" for k, line in enumerate(lines)
    ]
    return [line for k, old in enumerate(ended) for line in changes.get(k, [old])]
