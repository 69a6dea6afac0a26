"""Nastran bulk data as cards: name, fields, line. Small, large and free field format with continuations.

    small   10 fields of 8 columns           GRID    1               0.      0.      0.
    large   names end in *, fields of 16     GRID*   1                               0.              0.
    free    fields between commas            GRID,1,,0.,0.,0.

A continuation starts with +, * or a blank first field. `$` starts a comment. Only what stands between BEGIN BULK and
ENDDATA is read where these exist; INCLUDE is followed. Data fields are counted from 1 after
the name, eight to a line, as they stand in the manual's pictures without their first and last columns.
Source: MSC Nastran Quick Reference Guide, section 8 (bulk data format).
Checked in tests/io/nastran/test_cards.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from torchmbd.errors import InputError

_EXPONENT = re.compile(r"([0-9.])([+-][0-9]+)$")
_PER_LINE = 8  # data fields of a line of small fields, and of a pair of lines of large fields


@dataclass(frozen=True)
class Card:
    """One card; `fields` are the data fields in order, without names and continuation marks."""

    name: str
    fields: tuple[str, ...]
    where: str

    def __str__(self) -> str:
        number = self.fields[0] if self.fields else ""
        return f"{self.name} {number} ({self.where})"

    def text(self, position: int) -> str:
        """Data field `position`, counted from 1 after the name, "" where blank or missing."""
        return self.fields[position - 1] if position <= len(self.fields) else ""

    def real(self, position: int, name: str, default: float | None = None) -> float:
        """Read a number; 1.5+3 and 1.5D3 are 1500. InputError names card, line and field."""
        text = self.text(position)
        if not text and default is not None:
            return default
        try:
            return float(_EXPONENT.sub(r"\1E\2", text.upper().replace("D", "E")))
        except ValueError:
            raise InputError(f"{self}: {name} is {text!r}; allowed: a number") from None

    def integer(self, position: int, name: str, default: int | None = None) -> int:
        """Read an integer. InputError names card, line and field."""
        text = self.text(position)
        if not text and default is not None:
            return default
        try:
            return int(text)
        except ValueError:
            raise InputError(f"{self}: {name} is {text!r}; allowed: an integer") from None

    def integers(self, start: int) -> list[int]:
        """Read the list of integers from `start` on; `1 THRU 5` is a range."""
        result: list[int] = []
        words = [word for word in self.fields[start - 1 :] if word]
        k = 0
        while k < len(words):
            if words[k].upper() == "THRU":
                if not result or k + 1 >= len(words):
                    raise InputError(f"{self}: THRU stands without its two ends")
                end = _integer(self, words[k + 1])
                result.extend(range(result[-1] + 1, end + 1))
                k += 2
            else:
                result.append(_integer(self, words[k]))
                k += 1
        return result


def read_cards(path: str | Path) -> list[Card]:
    """Read the cards of a file. InputError names the line where the format is broken."""
    if not isinstance(path, (str, Path)) or not (file := Path(path)).is_file():
        raise InputError(f"path is {str(path)!r}; allowed: a Nastran bulk data file that exists")
    return parse_cards(_bulk(list(_lines(file, ()))))


def parse_cards(lines: list[tuple[str, str]]) -> list[Card]:
    """Make cards of (where, line) pairs."""
    cards: list[Card] = []
    name, fields, place = "", [], ""
    for where, line in lines:
        head, data = _split(line, where)
        if head[:1] in ("", "+", "*"):
            if not name:
                raise InputError(f"{where}: a continuation without a card: {line.strip()!r}")
            fields = fields + data
            continue
        if name:
            cards.append(Card(name, tuple(_trimmed(fields)), place))
        name, fields, place = head.rstrip("*"), data, where
    if name:
        cards.append(Card(name, tuple(_trimmed(fields)), place))
    return cards


def _lines(file: Path, opened: tuple[Path, ...]) -> Iterator[tuple[str, str]]:
    if file in opened:
        raise InputError(f"{file.name}: INCLUDE runs in a circle")
    for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        line = line.partition("$")[0].rstrip()
        where = f"{file.name}, line {number}"
        if line.upper().lstrip().startswith("INCLUDE"):
            target = file.parent / line.strip()[len("INCLUDE") :].strip().strip("'\"")
            if not target.is_file():
                raise InputError(f"{where}: INCLUDE of {str(target)!r}; allowed: a file that exists")
            yield from _lines(target, (*opened, file))
        elif line:
            yield where, line


def _bulk(lines: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The lines after BEGIN BULK, if it exists, up to ENDDATA."""
    start = next((k + 1 for k, (_, x) in enumerate(lines) if x.upper().split()[:2] == ["BEGIN", "BULK"]), 0)
    end = next((k for k, (_, x) in enumerate(lines) if x.strip().upper().startswith("ENDDATA")), len(lines))
    return lines[start:end]


def _split(line: str, where: str) -> tuple[str, list[str]]:
    """Name and data fields of one line."""
    if "," in line:
        words = [word.strip() for word in line.split(",")]
        head = words[0].upper()
        width = _PER_LINE // 2 if "*" in head else _PER_LINE
        beyond = [word for word in words[1 + width :] if word and word[0] not in "+*"]
        if beyond:
            raise InputError(
                f"{where}: {beyond[0]!r} is beyond the {width} data fields of a line; continue on the next line"
            )
        return head, (words[1:] + [""] * width)[:width]
    line = line.expandtabs(8)
    head = line[:8].strip().upper()
    if " " in head:
        raise InputError(f"{where}: {head!r} is no card name; is a field of 8 columns shifted?")
    width, count = (16, 4) if "*" in head else (8, _PER_LINE)
    return head, [line[8 + width * k : 8 + width * (k + 1)].strip() for k in range(count)]


def _trimmed(fields: list[str]) -> list[str]:
    while fields and not fields[-1]:
        fields = fields[:-1]
    return fields


def _integer(card: Card, word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise InputError(f"{card}: {word!r} stands in a list of numbers; allowed: integers and THRU") from None
