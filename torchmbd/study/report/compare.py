"""`torchmbd best` and `torchmbd compare`: the best designs of a study, and two studies side by side."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from torchmbd.errors import InputError
from torchmbd.study.record.metric_names import (
    CONVERGED,
    EVALUATIONS,
    INCREASE,
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
from torchmbd.study.report.progress import (
    CHANGE,
    change_cell,
    drop_order,
    print_table,
    table_of,
    violation_cell,
    wrapped_heading,
)
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
        raise InputError("count", count, rule="must be 1 or more", shown=f"{count}")
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
    names = list(dict.fromkeys(name for child in best for name in child.metrics if is_design(name)))
    table = _table(title)
    sign = -1.0 if entry.tags.get(GOAL) == MAXIMIZE else 1.0
    criteria = criterion_metrics((child.metrics for child in best), sign)
    titles = [CHANGE if name == gain_metric(sign) else metric_heading(name) for name in criteria]
    for title in ("", *titles, "viol.", *map(metric_heading, names), "status"):
        table.add_column(escape(wrapped_heading(title)), justify="right", no_wrap=True)
    for child in best:
        cells = [child.name, *(_cell(child, name, sign) for name in criteria)]
        violation = child.metrics.get("violation")
        cells.append("-" if violation is None else violation_cell(violation))
        cells += [number_text(name, child.metrics[name]) if name in child.metrics else "-" for name in names]
        table.add_row(*map(escape, cells), child.tags.get("status", child.status.lower()).replace("_", " "))
    if not print_table(table, console, drop_order(2 + len(criteria), len(names), [-1, 2])):
        for child in best:
            values = ", ".join(
                f"{metric_heading(name)} {number_text(name, child.metrics[name])}"
                for name in names
                if name in child.metrics
            )
            console.print(f"{child.name}: {values}", soft_wrap=True, highlight=False, markup=False)
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


def _cell(child: Entry, name: str, sign: float) -> str:
    """Return the text of a metric of a start; `sign` is -1 for an objective that is maximized, else 1."""
    if name not in child.metrics:
        return "-"
    return change_cell(child.metrics[name], sign) if name == gain_metric(sign) else f"{child.metrics[name]:.6g}"


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
            "two runs; torchmbd list has their ids",
            state=f"= {a!r} and b = {b!r} are the same run, {first.run_id[:8]}",
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
