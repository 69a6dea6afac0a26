"""Progress of a study on the terminal: a live table of the starts; tables that fit the width of the terminal.

Without a terminal: a line for each iteration of the best start, or for each search of a front.

Checked in tests/study/report/test_progress.py.
"""

from __future__ import annotations

import math
import textwrap
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

from torchmbd.summary import plural
from torchmbd.tracking.catalog import FEASIBLE

if TYPE_CHECKING:
    from torchmbd.optimization.optimizer import Iterate, OptimizationResult
    from torchmbd.study.report.columns import Columns

CHANGE = "change"  # heading of the change of the objective from start 0, the first design of the study
_HEADING = 12  # characters of a line of a heading
ROWS = 40  # of a table on the terminal, about; a screen has no more
_ROUNDING = 1e-12  # of constraints divided by their limits


class Beginning:
    """Says what a study does until it has results to show: compiling, the first batch."""

    def __init__(self, console: Console) -> None:
        self._console, self._began, self._last = console, time.monotonic(), ""

    def stage(self, name: str) -> None:
        """Say that a stage begins, once where it comes in several parts."""
        if name != self._last:
            self._console.out(f"{time.monotonic() - self._began:7.1f} s  {name}", highlight=False)
        self._last = name

    def batch(self, number: int, designs: int) -> None:
        """Say that the first batch begins."""
        if number == 1:
            self.stage(f"batch 1: {plural(designs, 'design')}")


class Progress:
    """Shows every iterate of every start; a context manager."""

    def __init__(
        self,
        columns: Columns,
        starts: int,
        title: str,
        console: Console,
        sign: float = 1.0,
        feasibility: float = FEASIBLE,
    ) -> None:
        self.columns, self.title, self.console = columns, title, console
        self.sign, self.feasibility = sign, feasibility
        self.latest: list[Iterate | None] = [None] * starts
        self.first = math.nan  # objective of the first design: what every start is compared with
        self.notes: list[str] = []
        self._best: Iterate | None = None
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
        if iterate.iteration == 0 and iterate.start == 0:
            self.first = iterate.objective
        self.latest[iterate.start] = iterate
        if self._best is None or self._rank(iterate) < self._rank(self._best):
            self._best = iterate
        if iterate.start == self._best.start and not self.console.is_terminal:
            self.console.out(self._line(iterate), highlight=False)

    def _rank(self, iterate: Iterate) -> tuple[float, float]:
        """Return a sort key: feasible iterates by objective, then infeasible ones by violation, then failed ones."""
        if iterate.status != "ok":
            return math.inf, math.inf
        violation = iterate.violation if iterate.violation > self.feasibility else 0.0
        return violation, iterate.objective

    def _line(self, iterate: Iterate) -> str:
        """Return the line of an iterate, with its design if it fits."""
        objective, change, violation = outcome_cells(self.first, iterate.objective, iterate.violation, self.sign)
        line = (
            f"{time.monotonic() - self._began:7.1f} s  start {iterate.start:<3d} iteration {iterate.iteration:<3d} "
            f"objective {objective}  {CHANGE} {change}"
        )
        line += f"  violation {violation}" if violation != "0" else ""
        values = "".join(f"  {value:z8.3f}" for value in self.columns.by_name(iterate.x).values())
        return line + values if len(line) + len(values) <= self.console.width else line

    def note(self, text: str) -> None:
        """Print a text above the table, once."""
        if text not in self.notes:
            self.notes.append(text)
            self.console.print(escape(text), style="red", soft_wrap=True)

    def _table(self) -> Table:
        title = f"{self.title}   {time.monotonic() - self._began:.0f} s"
        basics, headings = ["start", "iter", "objective", CHANGE, "viol."], self.columns.headings
        table = table_of(title, [*basics, *headings, "sims"])
        for start, iterate in enumerate(self.latest):
            if iterate is None:
                table.add_row(str(start), "-")
                continue
            values = [f"{value:z.2f}" for value in self.columns.by_name(iterate.x).values()]
            numbers = outcome_cells(self.first, iterate.objective, iterate.violation, self.sign)
            table.add_row(str(start), str(iterate.iteration), *numbers, *values, str(iterate.analyses))
        return fit_to_width(table, self.console, drop_order(len(basics), len(headings), [-1, 4, 3]))


class SearchCounter:
    """Counts the searches of a front as they end; a context manager."""

    def __init__(self, title: str, console: Console) -> None:
        self.title, self.console = title, console
        self.analyses: list[int] = []  # of every search that has ended
        self._began = time.monotonic()
        self._status = console.status(escape(title))

    def __enter__(self) -> SearchCounter:
        if self.console.is_terminal:
            self._status.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._status.stop()

    def ended(self, result: OptimizationResult) -> None:
        """Show how a search ended."""
        self.analyses.append(result.analyses)
        count = len(self.analyses)
        if self.console.is_terminal:
            self._status.update(f"{escape(self.title)}: {count} searches, {sum(self.analyses)} simulations")
            return
        line = (
            f"search {count:<3d} iterations {result.iterations:<3d} simulations {result.analyses:<4d} {result.status}"
        )
        self.console.out(f"{time.monotonic() - self._began:7.1f} s  {line.replace('_', ' ')}", highlight=False)


def table_of(title: str, headings: Sequence[str]) -> Table:
    """Return an empty table of numbers."""
    table = Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=0)
    for heading in headings:
        table.add_column(escape(wrapped_heading(heading)), justify="right", no_wrap=True)
    return table


def wrapped_heading(heading: str) -> str:
    """Return a heading in short lines, its unit in the last, for narrow columns."""
    name, bracket, unit = heading.partition(" [")
    lines = textwrap.wrap(name, _HEADING, break_long_words=False)
    return "\n".join([*lines, f"[{unit}"] if bracket else lines)


def drop_order(first: int, count: int, then: Sequence[int] = ()) -> list[int]:
    """Return indices of columns in the order in which they are left out: `count` from `first` on, last first, `then` others."""
    return [*range(first + count - 1, first - 1, -1), *then]


def shown_rows(count: int, best: int | None = None) -> list[int]:
    """Return which of `count` rows a table shows: all of a few, else evenly spaced ones, first, last and best among them."""
    if count <= ROWS:
        return list(range(count))
    spaced = {round(k * (count - 1) / (ROWS - 1)) for k in range(ROWS)}
    return sorted(spaced | ({best} if best is not None else set()))


def fit_to_width(table: Table, console: Console, optional: Sequence[int] = ()) -> Table:
    """Return the table without as many of its `optional` columns (in this order) as do not fit the terminal."""
    indices = list(range(len(table.columns)))
    part = table
    for index in (k % len(table.columns) for k in optional):
        if _width(part, console) <= console.width:
            break
        indices.remove(index)
        part = _part(table, indices)
    return part


def _width(table: Table, console: Console) -> int:
    return Measurement.get(console, console.options.update(width=1000), table).maximum


def _part(table: Table, indices: Sequence[int]) -> Table:
    """Return the columns `indices` of a table, with one column of dots for those that are left out."""
    part = Table(title=table.title, title_justify="left", box=table.box, pad_edge=False, padding=table.padding)
    gap = next(k for k in range(len(table.columns)) if k not in indices)
    shown = sorted([*indices, gap])
    for k in shown:
        column = table.columns[k]
        heading = "..." if k == gap else column.header
        part.add_column(heading, justify=column.justify, no_wrap=column.no_wrap, overflow=column.overflow)
    cells = [list(table.columns[k].cells) for k in shown]
    for row, line in enumerate(zip(*cells, strict=True)):
        style, section = table.rows[row].style, table.rows[row].end_section
        part.add_row(
            *("..." if k == gap else x for k, x in zip(shown, line, strict=True)), style=style, end_section=section
        )
    return part


def print_table(table: Table, console: Console, optional: Sequence[int] = ()) -> bool:
    """Print a table in the width of the terminal, see `fit_to_width`; return whether all its columns are printed."""
    title, table.title = table.title, None  # rich would break the title to the width of the table
    console.print(title, style="italic", soft_wrap=True)
    part = fit_to_width(table, console, optional)
    console.print(part)
    return part is table


def change_cell(reduction: float, sign: float) -> str:
    """Return the cell of the change of an objective, negative where it fell, from the reduction [%] of what is minimized."""
    return f"{-sign * reduction:+z.2f} %" if math.isfinite(reduction) else "-"


def outcome_cells(first: float, objective: float, violation: float, sign: float = 1.0) -> list[str]:
    """Return the cells of the objective (`sign` times what is minimized), its change from `first`, and the violation."""
    if math.isnan(objective):  # not evaluated
        return ["-", "-", "-"]
    reduction = 100.0 * (first - objective) / abs(first) if first else math.nan
    return [f"{sign * objective:.6g}", change_cell(reduction, sign), violation_cell(violation)]


def violation_cell(violation: float) -> str:
    """Return the cell of a violation; the rounding of an active constraint is not a violation."""
    return f"{violation:.0e}" if violation > _ROUNDING else "0"
