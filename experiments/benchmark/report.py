"""What a part of the benchmark returns: figures for the JSON object, and tables for people; the machine that ran it."""

from __future__ import annotations

import contextlib
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

Cell = str | float | int | None


@dataclass(frozen=True)
class Settings:
    """What is measured.

    peer      run the peer as well
    quick     seconds instead of minutes; what that cannot measure stays unmeasured
    problems, methods   of the part "methods", by name; none: all
    bodies              of the part "large", by name; none: those below 120,000 freedoms
    """

    peer: bool = False
    quick: bool = False
    problems: Sequence[str] = ()
    methods: Sequence[str] = ()
    bodies: Sequence[str] = ()

    @property
    def repeat(self) -> int:
        return 1 if self.quick else 5


@dataclass(frozen=True)
class Grid:
    """A table."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def show(self, console: Console) -> None:
        table = Table(title=self.title, title_justify="left")
        for i, column in enumerate(self.columns):
            table.add_column(column, justify="left" if i == 0 else "right")
        for row in self.rows:
            table.add_row(*(_text(cell) for cell in row))
        console.print(table)


@dataclass
class Result:
    """Figures by name (None: not measured) and tables."""

    figures: dict[str, Any] = field(default_factory=dict)
    tables: list[Grid] = field(default_factory=list)


def _text(cell: Cell) -> str:
    if cell is None:
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def ratio(a: float | None, b: float | None) -> float | None:
    """a / b, None where one of them was not measured."""
    return None if a is None or b is None else a / b


def machine() -> str:
    """Processor and number of cores."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}, {os.cpu_count()} cores"
