"""Errors of experiment files: all faults of a file in one exception, each with its line.

    Fault       path `optimizer.max_iterations`, line 12, text "= -1: input should be greater than 0"
    StudyError  all faults of one file; the terminal shows its text, without a traceback

Checked in tests/study/.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from torchmbd.errors import InputError, Path, dotted
from torchmbd.summary import plural
from torchmbd.tracking.uri import hidden

_MOST = 20  # faults in a message
_LONGEST = 2000  # characters of a fault
Lines = Mapping[Path, int | str]  # where a path was written: a line of the file, or an override's own text


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong, at one path of the file."""

    path: Path
    text: str
    where: int | str | None = None  # line number (from 1), or the override that set the value

    def __str__(self) -> str:
        place = f"line {self.where}: " if isinstance(self.where, int) else f"in {self.where}: " if self.where else ""
        joint = "" if self.text.startswith((":", " ")) or not self.path else " "
        return hidden(f"{place}{dotted(self.path)}{joint}{self.text if self.path else self.text.lstrip(': ')}".strip())


class StudyError(InputError):
    """An experiment file that cannot be run, with all its faults."""

    def __init__(self, source: str, faults: Iterable[Fault]) -> None:
        self.source = source
        self.faults = sorted(faults, key=lambda fault: (not isinstance(fault.where, int), str(fault.where).zfill(9)))
        count = plural(len(self.faults), "error")
        lines = [_short(str(fault)) for fault in self.faults[:_MOST]]
        more = [f"... and {len(self.faults) - _MOST} more"] if len(self.faults) > _MOST else []
        super().__init__("\n  ".join([f"{source}: {count}", *lines, *more]))


def _short(line: str) -> str:
    """Leave the middle out of a line too long to read."""
    half = _LONGEST // 2
    return line if len(line) <= _LONGEST else f"{line[:half]} ... {line[-half:]}"


def located(faults: Iterable[Fault], lines: Lines) -> list[Fault]:
    """Return the faults with the line of their path, or of its nearest parent in the file."""
    return [replace(fault, where=_line(fault.path, lines)) for fault in faults]


def _line(path: Path, lines: Lines) -> int | str | None:
    while path and path not in lines:
        path = path[:-1]
    return lines.get(path)


def shown(value: object, limit: int = 60) -> str:
    """Write a value for a message, cut to one short line."""
    text = (
        {True: "true", False: "false", None: "null"}[value]
        if value is None or isinstance(value, bool)
        else hidden(repr(value))
    )
    return text if len(text) <= limit else f"{text[: limit - 3]}..."
