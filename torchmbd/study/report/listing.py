"""What `torchmbd list` and `torchmbd ui` print: experiment files, studies so far, and links into the UI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.style import Style
from rich.table import Table
from rich.text import Text

from torchmbd.results.answer import MANY_FAILURES, NOT_VERIFIED
from torchmbd.study.file.config_index import configs
from torchmbd.study.record.metric_names import INCREASE, gain_metric
from torchmbd.study.report.progress import CHANGE, change_cell, print_table, wrapped_heading
from torchmbd.tracking.catalog import VERIFICATION, Entry, children, studies
from torchmbd.tracking.links import compare_link, experiment_link, run_link, view_link
from torchmbd.tracking.store import store_uri
from torchmbd.tracking.uri import StoreURI

_RECENT = 3  # studies whose links are printed
_COMPARED = 32  # runs in the link of a comparison, at most


def print_configs(folder: Path, console: Console) -> None:
    """Print the experiment files below a folder with their questions."""
    questions = configs(folder)
    if not questions:
        console.print(f"No experiment files in {escape(str(folder))}.", soft_wrap=True)
        return
    table = Table(title="experiment files", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("file", no_wrap=True)  # a name in one piece can be copied
    table.add_column("question")
    for file, question in questions.items():
        table.add_row(escape(str(file)), escape(question))
    print_table(table, console)


def print_studies(uri: str | None, console: Console) -> None:
    """Print the studies of a store, the newest first."""
    store = store_uri(uri)
    entries = studies(store)
    if not entries:
        console.print(f"No studies yet in {escape(str(store))}.", soft_wrap=True)
        return
    table = Table(title=f"studies in {escape(str(store))}", box=box.SIMPLE_HEAD, pad_edge=False, padding=0)
    for heading in ("experiment", "study", "kind", "began", "took", "status", "best objective", CHANGE, "run"):
        numbers = heading in ("took", "best objective", CHANGE)
        name = heading in ("experiment", "study")
        table.add_column(
            wrapped_heading(heading),
            justify="right" if numbers else "left",
            no_wrap=not name,
            overflow="fold" if name else "ellipsis",
        )
    for entry in entries:
        table.add_row(*map(escape, _cells(entry)))
    print_table(table, console, [2, 4, 0, 7])


def print_links(store: StoreURI, base: str, console: Console) -> None:
    """Print the links of every experiment and of the latest studies."""
    entries = studies(store)
    if not entries:
        console.print(f"{base}  (no studies yet)", soft_wrap=True)
        return
    for experiment_id, name in {entry.experiment_id: entry.experiment for entry in entries}.items():
        console.print(f"all runs of {escape(name)}", style="bold")
        print_links_of({"runs": experiment_link(base, experiment_id)}, console)
    for entry in entries[:_RECENT]:
        console.print(f"{escape(entry.name)}, {entry.began:%d %b %H:%M}, {entry.status.lower()}", style="bold")
        links = study_links(base, entry.experiment_id, entry.run_id, entry.kind, entry.status)
        runs = [run.run_id for run in children(store, entry)]
        if 1 < len(runs) <= _COMPARED:
            links["compare"] = compare_link(base, entry.experiment_id, runs)
        print_links_of(links, console)
    if console.is_terminal:
        console.print("Links that do not open at a click: torchmbd ui | cat prints them whole.")


def study_links(base: str, experiment_id: str, run_id: str, kind: str, status: str) -> dict[str, str]:
    """Return the links of a study by their labels; only a finished study has a motion."""
    links = {"table": view_link(base, experiment_id, run_id)} if kind in ("study", "front", "sweep") else {}
    if kind == "study":
        links["charts"] = view_link(base, experiment_id, run_id, charts=True)
    if kind == "study" and status == "FINISHED":
        links["motion"] = run_link(base, experiment_id, run_id, "artifacts/motion_best.html")
    return links | {"files": run_link(base, experiment_id, run_id, "artifacts")}


def print_links_of(links: Mapping[str, str], console: Console) -> None:
    """Print each link with its label in a line.

    A narrow terminal shows the beginning of a link, and opens the whole link; files and pipes get the whole text.
    """
    for label, link in links.items():
        line = Text(f"  {label:<8} ")
        width = console.width - len(line)
        cut = console.is_terminal and len(link) > width
        line.append(
            f"{link[: width - 3]}..." if cut else link,
            Style(link=link) if console.is_terminal and link.startswith("http") else None,
        )
        console.print(line, soft_wrap=True, highlight=False)


def _cells(entry: Entry) -> list[str]:
    def number(key: str, form: str) -> str:
        return form.format(entry.metrics[key]) if key in entry.metrics else "-"

    verification, sign = entry.tags.get(VERIFICATION, ""), -1.0 if INCREASE in entry.metrics else 1.0
    return [
        entry.experiment,
        entry.name,
        entry.kind,
        f"{entry.began:%d %b %H:%M}",
        "-" if entry.seconds is None else f"{entry.seconds:.0f} s",
        next((word for word in (NOT_VERIFIED, MANY_FAILURES) if verification.startswith(word)), entry.status.lower()),
        number("best_objective", "{:.6g}"),
        change_cell(entry.metrics.get(gain_metric(sign), math.nan), sign),
        entry.run_id[:8],
    ]
