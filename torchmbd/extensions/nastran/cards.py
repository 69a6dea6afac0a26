"""Nastran bulk data as cards: name, fields, line. Small, large and free field format with continuations.

    small   10 fields of 8 columns           GRID    1               0.      0.      0.
    large   names end in *, fields of 16     GRID*   1                               0.              0.
    free    fields between commas            GRID,1,,0.,0.,0.

A continuation starts with +, * or a blank first field, and stands below the line that it continues. `$` starts a comment.
Cards stand between BEGIN BULK and ENDDATA where these exist, parameters above them, too; INCLUDE is followed; lines that
repeat the card before (=) are written out (replication.py).
Source: MSC Nastran Quick Reference Guide, section 8 (bulk data format).
Checked in tests/extensions/nastran/test_cards.py.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from torchmbd.errors import InputError, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.control import Control, Lines
from torchmbd.extensions.nastran.replication import count_of, repeated, repeats

EQUATION = "DEQATN"  # a card of text, which has no fields
LINES = 5_000_000  # of a file with all that it includes: about 6 GB of memory
WIDEST = 10_000  # characters of a line
INCLUDES = 1_000  # files
NESTED = 100  # files that include one another in a chain
_BYTES = 100  # of a line, the mean of a whole file
_PER_LINE = 8  # data fields of a line of small fields, and of a pair of lines of large fields


class Deck(NamedTuple):
    """The cards of a file, and its case control; None: it has bulk data alone. The digest is that of all files read."""

    cards: list[Card]
    control: Control | None
    digest: str


class DeckText(NamedTuple):
    """The lines of a file as they are, with those of the files that it includes, and the digest and paths of all files read.

    Bytes that are not UTF-8 are surrogates, which the error handler "surrogateescape" writes again.
    """

    lines: list[str]
    digest: str
    paths: frozenset[Path]

    def bulk_lines(self) -> Lines:
        """Return the lines of the bulk data without comments, each with its index in `lines`."""
        return _sections(list(_without_comments((str(k), line) for k, line in enumerate(self.lines))))[1]


def read_deck(path: str | Path) -> Deck:
    """Read a file. InputError names the line where the format is broken."""
    files = _Files(_existing("path", path))
    above, bulk = _sections(list(_without_comments(files.read())))
    parameters = [(where, line) for where, line in above or [] if line.lstrip().upper().startswith("PARAM")]
    control = None if above is None else Control.of(above)
    return Deck(parse_cards([*parameters, *bulk]), control, files.hash.hexdigest())


def read_text(argument: str, path: str | Path) -> DeckText:
    """Read the lines of a file as they are; each INCLUDE gives way to the lines of the file that it names."""
    files = _Files(_existing(argument, path), "surrogateescape")
    return DeckText([line for _, line in files.read()], files.hash.hexdigest(), frozenset(files.paths))


def _existing(argument: str, path: Any) -> Path:
    if not isinstance(path, (str, Path)) or not Path(path).is_file():
        raise InputError(argument, str(path), "a Nastran bulk data file that exists")
    return Path(path)


def read_cards(path: str | Path) -> list[Card]:
    """Read the cards of a file. InputError names the line where the format is broken."""
    return read_deck(path).cards


def parse_cards(lines: Lines) -> list[Card]:
    """Make cards of (where, line) pairs."""
    cards: list[Card] = []
    name, fields, place = "", [], ""
    steps: list[str] = []  # data of the last line that repeats the card before it
    last, marks, others = "", set(), {}  # names of continuations: of the line before, of all, of those not below theirs
    for where, line in lines:
        if name == EQUATION and line[:8].strip()[:1] in ("", "+", "*"):
            continue
        head, data, mark = _split(line, where)
        before, last = last, mark
        marks.add(mark)
        if head[:1] in ("", "+", "*"):
            if not name or repeats(data):
                wrong = "without a card" if not name else "that repeats another"
                raise wrong_entry(where, f"a continuation {wrong}: {line.strip()!r}")
            if (label := head.lstrip("+*")) not in ("", before):
                others[label] = where
            fields.extend(data)
            continue
        if name:
            cards.append(Card(name, tuple(_trimmed(fields)), place))
        if (count := count_of(head, where)) is not None:
            if not steps or len(cards) + count > LINES:
                raise wrong_entry(where, f"{head!r}", f"below a line that repeats a card, {LINES} cards in all")
            for _ in range(count):
                cards.append(repeated(cards[-1], steps, where))
            name = ""
            continue
        if head == "=" or repeats(data):
            made = repeated(cards[-1] if cards else None, data, where)
            if head not in ("=", made.name):
                raise wrong_entry(where, f"{head} repeats {cards[-1]}", "must repeat a card of the same name")
            name, fields, place, steps = made.name, [*made.fields, *[""] * (len(data) - len(made.fields))], where, data
        else:
            name, fields, place, steps = head.rstrip("*"), data, where, []
    for label in others.keys() & marks:
        raise wrong_entry(
            others[label], f"the continuation {label!r} is not below the line that it continues", "below it"
        )
    if name:
        cards.append(Card(name, tuple(_trimmed(fields)), place))
    return cards


def line_kind(line: str) -> str:
    """Return "card", "continuation", or "repetition" for a line that repeats the card before it."""
    head, data, _ = _split(line, "")
    repetition = head[:1] == "=" or repeats(data)
    return "repetition" if repetition else "continuation" if head[:1] in ("", "+", "*") else "card"


class _Files:
    """Lines of a file and of those that it includes, from its own folder only; what is read is bounded.

    errors  how bytes that are not UTF-8 are read: as `open` takes it
    """

    def __init__(self, first: Path, errors: str = "replace") -> None:
        self.first, self.folder, self.lines, self.files = first, first.resolve().parent, 0, 0
        self.errors, self.hash, self.paths = errors, hashlib.sha256(), set[Path]()

    def read(self) -> Iterator[tuple[str, str]]:
        """Yield (where, line) with comments and ends of lines."""
        return self._read(self.first, ())

    def _read(self, file: Path, opened: tuple[Path, ...]) -> Iterator[tuple[str, str]]:
        file, self.files = file.resolve(), self.files + 1
        if file in opened:
            raise wrong_entry(file.name, "INCLUDE runs in a circle", key="INCLUDE")
        if self.files > INCLUDES:
            raise wrong_entry(
                file.name, f"more than {INCLUDES} files are included", f"at most {INCLUDES}", key="INCLUDE"
            )
        if len(opened) > NESTED:
            raise wrong_entry(
                file.name, f"INCLUDE in a chain of more than {NESTED} files", f"at most {NESTED}", key="INCLUDE"
            )
        if file.stat().st_size > _BYTES * LINES:
            raise InputError(
                file.name,
                allowed=f"must have at most {LINES} lines, {_BYTES * LINES} bytes",
                state=f"has {file.stat().st_size} bytes",
            )
        self.hash.update(file.read_bytes())
        self.paths.add(file)
        with file.open(encoding="utf-8-sig", errors=self.errors, newline="") as handle:
            numbered = enumerate(iter(lambda: handle.readline(WIDEST), ""), start=1)
            for number, raw in numbered:
                self.lines += 1
                where = f"{file.name}, line {number}"
                if self.lines > LINES or len(raw) >= WIDEST:
                    raise wrong_entry(
                        where,
                        "the file or the line is too long",
                        f"must have at most {LINES} lines of at most {WIDEST} characters",
                    )
                line = raw.partition("$")[0].strip()
                if not line.upper().startswith("INCLUDE"):
                    yield where, raw
                    continue
                named = line[len("INCLUDE") :].strip()
                while named[:1] in ("'", '"') and named.count(named[0]) < 2:  # the name goes on
                    _, more = next(numbered, (0, ""))
                    if not more:
                        raise wrong_entry(where, f"INCLUDE of {named!r} has no closing quote", key="INCLUDE")
                    named += more.strip()
                yield from self._read(self._target(file, named.strip("'\" "), where), (*opened, file))

    def _target(self, file: Path, named: str, where: str) -> Path:
        """The file that INCLUDE names: beside the file that includes it, or beside the first one."""
        relative = named.replace("\\", "/")
        for base in (file.parent, self.folder):
            try:
                target = (base / relative).resolve()
                is_file = target.is_file()
            except (OSError, ValueError):
                continue
            if is_file and not target.is_relative_to(self.folder):
                raise wrong_entry(
                    where, f"INCLUDE of {named!r} is outside of {self.folder}", "must name a file inside", key="INCLUDE"
                )
            if is_file:
                return target
        raise wrong_entry(where, f"INCLUDE of {named!r}", "must name a file that exists", key="INCLUDE")


def _without_comments(lines: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Yield the lines that have more than a comment, without it."""
    for where, raw in lines:
        if line := raw.partition("$")[0].rstrip():
            yield where, line


def _sections(lines: Lines) -> tuple[Lines | None, Lines]:
    """The lines above BEGIN BULK, None without it, and those after it, up to ENDDATA.

    BEGIN SUPER is such a line where no other cards are above it: the punch file of one external superelement.
    """
    begin = next((k for k, (_, x) in enumerate(lines) if x.upper().split()[:2] == ["BEGIN", "BULK"]), None)
    if begin is None and lines and lines[0][1].upper().replace("=", " ").split()[:2] == ["BEGIN", "SUPER"]:
        begin = 0
    start = 0 if begin is None else begin + 1
    end = next((k for k, (_, x) in enumerate(lines) if x.strip().upper().startswith("ENDDATA")), len(lines))
    again = [(where, x) for where, x in lines[start:end] if x.upper().split()[:1] == ["BEGIN"]]
    if again:
        where, line = again[0]
        raise wrong_entry(where, f"{line.strip()!r} begins a superelement", "must have one section, BEGIN BULK")
    return None if begin is None else lines[:begin], lines[start:end]


def _split(line: str, where: str) -> tuple[str, list[str], str]:
    """Name and data fields of one line, and the name of its continuation, which stands in the tenth field."""
    if line[:8].strip().upper() == EQUATION:
        return EQUATION, [], ""
    if line.lstrip().startswith("=("):  # it may be wider than a field
        return line.strip().rstrip(",").upper(), [], ""
    if "," in line:
        words = [word.strip() for word in line.split(",")]
        head = words[0].upper()
        width = _PER_LINE // 2 if "*" in head else _PER_LINE
        beyond = [word for word in words[1 + width :] if word and word[0] not in "+*"]
        if beyond:
            raise wrong_entry(
                where,
                f"{beyond[0]!r} is beyond the {width} data fields of a line",
                hint="a continuation on the next line",
            )
        mark = next((word for word in words[1 + width :] if word), "")
        return head, (words[1:] + [""] * width)[:width], mark.lstrip("+*").upper()
    line = line.expandtabs(8)
    head = re.sub(r" +\*$", "*", line[:8].strip().upper())  # Nastran punches "GRID   *"
    if " " in head and head[0] not in "+*":
        raise wrong_entry(
            where, f"{head!r} is not the name of a card", hint="fields of 8 columns, of which one may be shifted"
        )
    width, count = (16, 4) if "*" in head else (8, _PER_LINE)
    fields = [line[8 + width * k : 8 + width * (k + 1)].strip() for k in range(count)]
    return head, fields, line[72:80].strip().lstrip("+*").upper()


def _trimmed(fields: list[str]) -> list[str]:
    while fields and not fields[-1]:
        fields = fields[:-1]
    return fields
