"""`torchmbd best` and `torchmbd compare`: the best designs of a study, and two studies side by side."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from torchmbd.errors import InputError
from torchmbd.study.record.metric_names import (
    ANALYSES,
    CONVERGED,
    EVALUATIONS,
    INCREASE,
    ITERATIONS,
    REDUCTION,
    STARTS,
    cell_text,
    criterion_metrics,
    gain_metric,
    is_design,
    metric_heading,
    number_text,
    without_group,
)
from torchmbd.study.report.answers import comparison, print_answers, stored_verification
from torchmbd.study.report.progress import CHANGE, change_cell, drop_order, print_table, table_of, violation_cell
from torchmbd.tracking.catalog import (
    ACTIVE,
    GOAL,
    MAXIMIZE,
    SEARCH_TEXT,
    VERIFICATION,
    Entry,
    children,
    find,
    studies,
    tables,
)
from torchmbd.tracking.store import own_files, store_uri
from torchmbd.tracking.uri import hidden

_OUTCOME = ("best_objective", REDUCTION, INCREASE, "violation", STARTS, CONVERGED, EVALUATIONS)
_IGNORED = (
    "mlflow.",
    "version.",
    "torchmbd.",
    "message",
    "machine",
    "study_key",
    "run_key",
    "process",
    "problem_key",
    "files",
    VERIFICATION,
    SEARCH_TEXT,
    "last_failure",
    ACTIVE,
)


def print_best(run: str | None, uri: str | None, count: int, console: Console) -> None:
    """Print the best starts (or points) of a study; `run` None: of the latest study."""
    if count < 1:
        raise InputError("count", count, "1 or more", shown=f"{count}")
    store = store_uri(uri)
    entry = find(store, run) if run else next(iter(studies(store)), None)
    if entry is None:
        console.print(f"No studies yet in {escape(str(store))}.", soft_wrap=True)
        return
    with tempfile.TemporaryDirectory(prefix="torchmbd-") as scratch:
        verified = stored_verification(store, entry, Path(scratch))
        stored = tables(store, entry, Path(scratch))
    title = f"{entry.name}, {entry.began:%d %b %H:%M}, {entry.status.lower()}, run {entry.run_id[:8]}"
    if stored:  # a fit: its answer is not a list of designs
        _print_tables(title, stored, console)
        files = own_files(store, entry.run_id)
        place = f"artifacts of run {entry.run_id[:8]}" if files is None else os.path.relpath(files)
        console.print(f"its files: {place}", highlight=False, markup=False, soft_wrap=True)
        return
    best = [child for child in children(store, entry) if "objective" in child.metrics][:count]
    starts, sign = [Start.of(child) for child in best], goal_sign(entry)
    if not print_starts(title, starts, sign, console):
        headings = start_headings(starts, sign)
        for child in best:
            values = [
                f"{headings[name]} {number_text(name, x)}" for name, x in child.metrics.items() if is_design(name)
            ]
            console.print(f"{child.name}: {', '.join(values)}", soft_wrap=True, highlight=False, markup=False)
    if verified is not None:
        print_answers(verified, console)
    for tag in (SEARCH_TEXT, ACTIVE):
        if tag in entry.tags and not (tag == SEARCH_TEXT and verified):
            console.print(f"{tag}: {entry.tags[tag]}", highlight=False, markup=False, soft_wrap=True)
    model = entry.params.get("model", "").rpartition(":")[0]
    expression = (
        f'torchmbd.load("{entry.run_id[:8]}", model="{model}")'
        if model and entry.kind == "study"
        else "the same mbd.Study; its run() reads what is there"
    )
    console.print(
        f"in Python: {expression}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


def _print_tables(title: str, stored: dict[str, list[list[str]]], console: Console) -> None:
    """Print the tables that a run has stored."""
    console.print(title, highlight=False, markup=False, soft_wrap=True)
    for name, (headings, *rows) in stored.items():
        table = table_of(name, [heading.replace("_", " ") for heading in headings])
        for row in rows:
            table.add_row(*(escape(cell_text(cell)) for cell in row))
        print_table(table, console, drop_order(2, len(headings) - 2))


def goal_sign(entry: Entry) -> float:
    """Return -1 for a study whose objective is maximized, else 1."""
    return -1.0 if entry.tags.get(GOAL) == MAXIMIZE else 1.0


class Start(NamedTuple):
    """A row of the table of starts, or of points: name, metrics, status, and whether it is the best."""

    name: str
    metrics: Mapping[str, float]
    status: str
    best: bool = False

    @classmethod
    def of(cls, run: Entry) -> Start:
        """The row of a run of the store."""
        status = run.tags.get("status", run.status.lower())
        return cls(run.name, run.metrics, status, run.tags.get("best") == "true")


def start_headings(starts: Sequence[Start], sign: float) -> dict[str, str]:
    """Return metric -> heading of the columns of the table of starts: criteria, violation, design, cost."""
    known = dict.fromkeys(name for start in starts for name in start.metrics)
    criteria = criterion_metrics((start.metrics for start in starts), sign)
    short = {gain_metric(sign): CHANGE, "violation": "viol.", ITERATIONS: "iter", ANALYSES: "sims"}
    columns = [*criteria, "violation", *filter(is_design, known), ITERATIONS, ANALYSES]
    return {name: short.get(name, metric_heading(name)) for name in columns if name in known}


def start_cells(start: Start, headings: Mapping[str, str], sign: float) -> list[str]:
    """Return the cells of a row of this table: the name, one for each heading, the status."""
    texts = {name: number_text(name, x) for name, x in start.metrics.items()}
    for name, text in ((gain_metric(sign), partial(change_cell, sign=sign)), ("violation", violation_cell)):
        if name in texts:
            texts[name] = text(start.metrics[name])
    return [start.name, *(texts.get(name, "-") for name in headings), start.status.replace("_", " ")]


def print_starts(title: str, starts: Sequence[Start], sign: float, console: Console, heading: str = "") -> bool:
    """Print the table of starts in the width of the terminal; return whether all its columns are printed."""
    headings = start_headings(starts, sign)
    table = table_of(title, [heading, *headings.values(), "status"])
    for start in starts:
        table.add_row(*map(escape, start_cells(start, headings, sign)), style="bold" if start.best else None)
    columns = list(headings)
    optional = [*reversed([*filter(is_design, columns)]), ANALYSES, ITERATIONS, "violation", gain_metric(sign)]
    return print_table(table, console, [1 + columns.index(name) for name in optional if name in headings])


def outcomes(*metrics: Mapping[str, float]) -> list[str]:
    """Return names of outcomes, then of design variables, that any of several runs has."""
    names = dict.fromkeys(name for of_run in metrics for name in of_run)
    return [*(name for name in _OUTCOME if name in names), *(name for name in names if is_design(name))]


def print_comparison(a: str, b: str, uri: str | None, console: Console) -> None:
    """Print in what the files of two studies differ, and how they ended."""
    store = store_uri(uri)
    first, second = find(store, a), find(store, b)
    if first.run_id == second.run_id:
        raise InputError(
            "a",
            a,
            "two runs",
            shown=repr(a),
            state=f"and b = {b!r} are the same run, {first.run_id[:8]}",
            hint="torchmbd list, which shows their ids",
        )
    table = _table("what differs, and how they ended")
    for title in ("", f"{first.name} {first.run_id[:8]}", f"{second.name} {second.run_id[:8]}"):
        table.add_column(escape(title), overflow="fold")
    for row in differences(first, second):
        table.add_row(*map(escape, row))
    table.add_section()
    with tempfile.TemporaryDirectory(prefix="torchmbd-") as scratch:
        verified = [stored_verification(store, entry, Path(scratch)) for entry in (first, second)]
    for row in comparison(*verified):
        table.add_row(*map(escape, row))
    for tag in (VERIFICATION, SEARCH_TEXT, ACTIVE):
        table.add_row(tag, *(escape(entry.tags.get(tag, "-")) for entry in (first, second)))
    table.add_section()
    for name in outcomes(first.metrics, second.metrics):
        table.add_row(
            escape(without_group(name)),
            *(number_text(name, e.metrics[name]) if name in e.metrics else "-" for e in (first, second)),
        )
    took = ["-" if e.seconds is None else f"{e.seconds:.0f} s" for e in (first, second)]
    table.add_row("took", *took)
    print_table(table, console)


def differences(first: Entry, second: Entry) -> list[tuple[str, str, str]]:
    """Return the parameters and tags in which two studies differ: name, value of the first, value of the second."""
    rows = []
    for a, b in ((first.params, second.params), (first.tags, second.tags)):
        for name in dict.fromkeys([*a, *b]):
            values = a.get(name, "-"), b.get(name, "-")
            if values[0] != values[1] and not name.startswith(_IGNORED):
                rows.append((name, *map(hidden, values)))
    return rows


def _table(title: str) -> Table:
    return Table(title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
