"""Nastran bulk data as cards: name, fields, line. Small, large and free field format with continuations.

    small   10 fields of 8 columns           GRID    1               0.      0.      0.
    large   names end in *, fields of 16     GRID*   1                               0.              0.
    free    fields between commas            GRID,1,,0.,0.,0.

A continuation starts with +, * or a blank first field, and stands below the line that it continues. `$` starts a comment.
Only what stands between BEGIN BULK and ENDDATA is read where these exist; INCLUDE is followed. Data fields are counted from
1 after the name, eight to a line, as they stand in the manual's pictures without their first and last columns.
Source: MSC Nastran Quick Reference Guide, section 8 (bulk data format).
Checked in tests/io/nastran/test_cards.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from torchmbd.errors import InputError

_EXPONENT = re.compile(r"([0-9.])([+-][0-9]+)$")
_REAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(E[+-]?[0-9]+)?")
_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
LINES = 5_000_000  # of a file with all that it includes: about 6 GB of memory
WIDEST = 10_000  # characters of a line
INCLUDES = 1_000  # files
NESTED = 100  # files that include one another in a chain
_BYTES = 100  # of a line, the mean of a whole file
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
        plain = _EXPONENT.sub(r"\1E\2", text.upper().replace("D", "E"))
        if not _REAL.fullmatch(plain) or not math.isfinite(value := float(plain)):
            raise InputError(f"{self}: {name} is {text!r}; allowed: a number")
        return value

    def integer(self, position: int, name: str, default: int | None = None) -> int:
        """Read an integer. InputError names card, line and field."""
        text = self.text(position)
        if not text and default is not None:
            return default
        if not _INTEGER.fullmatch(text):
            raise InputError(f"{self}: {name} is {text!r}; allowed: an integer")
        return int(text)

    def integers(self, start: int, known: Collection[int]) -> list[int]:
        """Read the list of integers from `start` on; `1 THRU 5` is a range, of which only `known` numbers count."""
        result: list[int] = []
        words = [word for word in self.fields[start - 1 :] if word]
        k = 0
        while k < len(words):
            if words[k].upper() == "THRU":
                if not result or k + 1 >= len(words):
                    raise InputError(f"{self}: THRU stands without its two ends")
                end = _integer(self, words[k + 1])
                inside = range(result[-1] + 1, end + 1)
                smaller, other = (inside, known) if len(inside) < len(known) else (known, inside)
                result.extend(sorted(x for x in smaller if x in other))
                k += 2
            else:
                result.append(_integer(self, words[k]))
                k += 1
        return result


def read_cards(path: str | Path) -> list[Card]:
    """Read the cards of a file. InputError names the line where the format is broken."""
    if not isinstance(path, (str, Path)) or not (file := Path(path)).is_file():
        raise InputError(f"path is {str(path)!r}; allowed: a Nastran bulk data file that exists")
    return parse_cards(_bulk(list(_Files(file).read(file, ()))))


def parse_cards(lines: list[tuple[str, str]]) -> list[Card]:
    """Make cards of (where, line) pairs."""
    cards: list[Card] = []
    name, fields, place = "", [], ""
    last, marks, others = (
        "",
        set(),
        {},
    )  # names of continuations: of the line before, of all lines, of those not below theirs
    for where, line in lines:
        head, data, mark = _split(line, where)
        before, last = last, mark
        marks.add(mark)
        if head[:1] in ("", "+", "*"):
            if not name:
                raise InputError(f"{where}: a continuation without a card: {line.strip()!r}")
            if (own := head.lstrip("+*")) not in ("", before):
                others[own] = where
            fields.extend(data)
            continue
        if name:
            cards.append(Card(name, tuple(_trimmed(fields)), place))
        name, fields, place = head.rstrip("*"), data, where
    for own in others.keys() & marks:
        raise InputError(
            f"{others[own]}: the continuation {own!r} is not below the line that it continues; allowed: below it"
        )
    if name:
        cards.append(Card(name, tuple(_trimmed(fields)), place))
    return cards


class _Files:
    """Lines of a file and of those that it includes, from its own folder only; what is read is bounded."""

    def __init__(self, first: Path) -> None:
        self.folder, self.lines, self.files = first.resolve().parent, 0, 0

    def read(self, file: Path, opened: tuple[Path, ...]) -> Iterator[tuple[str, str]]:
        file, self.files = file.resolve(), self.files + 1
        if file in opened:
            raise InputError(f"{file.name}: INCLUDE runs in a circle")
        if self.files > INCLUDES:
            raise InputError(f"{file.name}: more than {INCLUDES} files are included; allowed: {INCLUDES}")
        if len(opened) > NESTED:
            raise InputError(f"{file.name}: INCLUDE in a chain of more than {NESTED} files; allowed: {NESTED}")
        if file.stat().st_size > _BYTES * LINES:
            raise InputError(
                f"{file.name} has {file.stat().st_size} bytes; allowed: {LINES} lines, {_BYTES * LINES} bytes"
            )
        with file.open(encoding="utf-8-sig", errors="replace") as handle:
            numbered = enumerate(iter(lambda: handle.readline(WIDEST), ""), start=1)
            for number, raw in numbered:
                self.lines += 1
                where = f"{file.name}, line {number}"
                if self.lines > LINES or len(raw) >= WIDEST:
                    raise InputError(f"{where}: allowed: {LINES} lines of at most {WIDEST} characters")
                line = raw.partition("$")[0].rstrip()
                if not line.upper().lstrip().startswith("INCLUDE"):
                    if line:
                        yield where, line
                    continue
                named = line.strip()[len("INCLUDE") :].strip()
                while named[:1] in ("'", '"') and named.count(named[0]) < 2:  # the name goes on
                    _, more = next(numbered, (0, ""))
                    if not more:
                        raise InputError(f"{where}: INCLUDE of {named!r} has no closing quote")
                    named += more.strip()
                yield from self.read(self._target(file, named.strip("'\" "), where), (*opened, file))

    def _target(self, file: Path, named: str, where: str) -> Path:
        """The file that INCLUDE names: beside the file that includes it, or beside the first one."""
        relative = named.replace("\\", "/")
        for base in (file.parent, self.folder):
            try:
                target = (base / relative).resolve()
                found = target.is_file()
            except (OSError, ValueError):
                continue
            if found and not target.is_relative_to(self.folder):
                raise InputError(f"{where}: INCLUDE of {named!r} is outside of {self.folder}; allowed: a file inside")
            if found:
                return target
        raise InputError(f"{where}: INCLUDE of {named!r}; allowed: a file that exists")


def _bulk(lines: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The lines after BEGIN BULK, if it exists, up to ENDDATA."""
    start = next((k + 1 for k, (_, x) in enumerate(lines) if x.upper().split()[:2] == ["BEGIN", "BULK"]), 0)
    end = next((k for k, (_, x) in enumerate(lines) if x.strip().upper().startswith("ENDDATA")), len(lines))
    again = [(where, x) for where, x in lines[start:end] if x.upper().split()[:1] == ["BEGIN"]]
    if again:
        where, line = again[0]
        raise InputError(f"{where}: {line.strip()!r} begins a superelement; allowed: one section, BEGIN BULK")
    return lines[start:end]


def _split(line: str, where: str) -> tuple[str, list[str], str]:
    """Name and data fields of one line, and the name of its continuation, which stands in the tenth field."""
    if "," in line:
        words = [word.strip() for word in line.split(",")]
        head = words[0].upper()
        width = _PER_LINE // 2 if "*" in head else _PER_LINE
        beyond = [word for word in words[1 + width :] if word and word[0] not in "+*"]
        if beyond:
            raise InputError(
                f"{where}: {beyond[0]!r} is beyond the {width} data fields of a line; continue on the next line"
            )
        mark = next((word for word in words[1 + width :] if word), "")
        return head, (words[1:] + [""] * width)[:width], mark.lstrip("+*").upper()
    line = line.expandtabs(8)
    head = line[:8].strip().upper()
    if " " in head and head[0] not in "+*":
        raise InputError(f"{where}: {head!r} is no card name; is a field of 8 columns shifted?")
    width, count = (16, 4) if "*" in head else (8, _PER_LINE)
    fields = [line[8 + width * k : 8 + width * (k + 1)].strip() for k in range(count)]
    return head, fields, line[72:80].strip().lstrip("+*").upper()


def _trimmed(fields: list[str]) -> list[str]:
    while fields and not fields[-1]:
        fields = fields[:-1]
    return fields


def _integer(card: Card, word: str) -> int:
    if not _INTEGER.fullmatch(word):
        raise InputError(f"{card}: {word!r} stands in a list of numbers; allowed: integers and THRU")
    return int(word)
