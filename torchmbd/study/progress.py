"""Progress on the terminal: a live table of the starts; one line per iteration where the output is no terminal."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

if TYPE_CHECKING:
    from torchmbd.optimization.optimizer import Iterate
    from torchmbd.study.columns import Columns


class Progress:
    """Shows every iterate of every start; a context manager."""

    def __init__(self, columns: Columns, starts: int, title: str, console: Console) -> None:
        self.columns, self.title, self.console = columns, title, console
        self.latest: list[Iterate | None] = [None] * starts
        self.first: list[float] = [float("nan")] * starts
        self.notes: list[str] = []
        self._began = time.monotonic()
        self._live = Live(console=console, get_renderable=self._table, refresh_per_second=4, transient=True)

    def __enter__(self) -> Progress:
        if self.console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._live.stop()

    def iterate(self, iterate: Iterate) -> None:
        """Show an iterate."""
        if iterate.iteration == 0:
            self.first[iterate.start] = iterate.objective
        self.latest[iterate.start] = iterate
        if not self.console.is_terminal:
            values = "  ".join(f"{value:z8.3f}" for value in self.columns.shown(iterate.x).values())
            self.console.out(
                f"{time.monotonic() - self._began:7.1f} s  start {iterate.start:3d}  iteration {iterate.iteration:3d}  "
                f"objective {iterate.objective:.6g}  violation {iterate.violation:.1e}  {values}",
                highlight=False,
            )

    def note(self, text: str) -> None:
        """Say something once, above the table."""
        if text not in self.notes:
            self.notes.append(text)
            self.console.print(escape(text), style="red", soft_wrap=True)

    def _table(self) -> Table:
        title = f"{self.title}   {time.monotonic() - self._began:.0f} s"
        headings = self.columns.headings
        table = table_of(title, ["start", "iter", "objective", "less by", "viol.", *headings, "sims"])
        for start, iterate in enumerate(self.latest):
            if iterate is None:
                table.add_row(str(start), "-")
                continue
            values = [f"{value:z.2f}" for value in self.columns.shown(iterate.x).values()]
            numbers = outcome(self.first[start], iterate.objective, iterate.violation)
            table.add_row(str(start), str(iterate.iteration), *numbers, *values, str(iterate.analyses))
        return table


def table_of(title: str, headings: Sequence[str]) -> Table:
    """Return an empty table of numbers."""
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=0)
    for heading in headings:
        words = heading.replace(" [", "\n[")  # the unit below the name: columns of numbers are narrow
        table.add_column(escape(words), justify="right", no_wrap=True)
    return table


def print_table(table: Table, console: Console) -> None:
    """Print a table as wide as it is: a terminal may break its lines, but no number is cut."""
    title, table.title = table.title, None  # a title inside is broken to the table's width
    console.print(title, style="italic")
    needed = Measurement.get(console, console.options.update(width=1000), table).maximum
    if needed > console.width:
        console = Console(file=console.file, width=needed, force_terminal=console.is_terminal)
    console.print(table)


def outcome(first: float, objective: float, violation: float) -> list[str]:
    """Return the cells objective, reduction from the start, violation."""
    less = f"{100.0 * (1.0 - objective / first):.2f} %" if first else "-"
    return [f"{objective:.6g}", less, f"{violation:.0e}" if violation else "0"]
