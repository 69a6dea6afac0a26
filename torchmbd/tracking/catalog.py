"""Read a tracking store: its studies, their starts, metrics and files."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from torchmbd.errors import InputError
from torchmbd.tracking.run_process import end_killed
from torchmbd.tracking.store import all_runs, open_store, own_files, store_uri
from torchmbd.tracking.uri import StoreURI

PARTS = ("start", "point")  # kinds of runs within a study
TABLES = "tables"  # tag of a study: headings of its report -> CSV files of the run, as JSON
GOAL, MAXIMIZE = "goal", "maximize"  # tag of a study whose objective is maximized
VERIFICATION = "verification"  # tag of a study: "verified: ...", "not verified: ..." or "many evaluations failed: ..."
SEARCH_TEXT = "search"  # tag of a study: how its searches ended, whether the best design is better, what failed
ACTIVE = "active"  # tag of a study: constraints and bounds that hold the best design
FEASIBLE = 1e-6  # largest violation of a constraint in a feasible design


@dataclass(frozen=True)
class Entry:
    """One study of a store."""

    experiment: str
    experiment_id: str
    run_id: str
    name: str
    kind: str  # "study", "front", "sweep", "figures", or that of an extension
    status: str
    began: datetime
    seconds: float | None  # None while it runs
    metrics: dict[str, float]
    params: dict[str, str]
    tags: dict[str, str]


def studies(uri: StoreURI | str) -> list[Entry]:
    """Return the studies of a store, the newest first, and end those that were killed in it.

    A SQLite file that does not exist is not created.
    """
    uri = store_uri(uri)
    if uri.file is not None and not uri.file.exists():
        return []
    client = open_store(uri)
    names = {e.experiment_id: e.name for e in client.search_experiments()}
    if not names:
        return []
    end_killed(client, list(names))
    runs = all_runs(client, list(names), " AND ".join(f"tags.kind != '{kind}'" for kind in PARTS))
    entries = [_entry(run, run.data.tags["kind"], names[run.info.experiment_id]) for run in runs]
    return sorted(entries, key=lambda entry: entry.began, reverse=True)


def find(uri: StoreURI | str, run: str) -> Entry:
    """Return the latest study with a run id that begins with `run`, or of the name `run`; InputError if there is none."""
    entries = studies(uri)
    for entry in entries:
        if entry.run_id.startswith(run) or entry.name == run:
            return entry
    place, names = store_uri(uri), list(dict.fromkeys(entry.name for entry in entries))
    if not names:
        hint = "another store, or `torchmbd run`, which makes a study"
        raise InputError(
            "run", run, hint=hint, state=f"{run!r} does not exist, because there are no studies in {place}"
        )
    raise InputError("run", run, names, noun=f"run in {place}", hint="a run id of torchmbd list")


def fetch(uri: StoreURI, entry: Entry, name: str, folder: Path) -> Path | None:
    """Copy a file of a run into a folder and return its path; None if the run has no such file."""
    if source := own_files(uri, entry.run_id):
        return Path(shutil.copy(source / name, folder)) if (source / name).is_file() else None
    client = open_store(uri)
    parent = str(Path(name).parent) if "/" in name else None
    if all(item.path != name for item in client.list_artifacts(entry.run_id, parent)):
        return None
    return Path(client.download_artifacts(entry.run_id, name, str(folder)))


def tables(uri: StoreURI, entry: Entry, folder: Path) -> dict[str, list[list[str]]]:
    """Return the tables that a run has by its tag, heading -> rows, the first of which names the columns.

    folder  takes copies of the files
    """
    result = {}
    for title, name in json.loads(entry.tags.get(TABLES, "{}")).items():
        if file := fetch(uri, entry, name, folder):
            with file.open(newline="", encoding="utf-8") as lines:
                result[title] = list(csv.reader(lines))
    return result


def files(uri: StoreURI, entry: Entry, folder: str) -> list[str]:
    """Return the names of the files in a folder of a run; "": those beside the folders."""
    if source := own_files(uri, entry.run_id):
        return sorted(str(path.relative_to(source)) for path in (source / folder).glob("*") if path.is_file())
    return [item.path for item in open_store(uri).list_artifacts(entry.run_id, folder or None) if not item.is_dir]


def children(uri: StoreURI | str, entry: Entry) -> list[Entry]:
    """Return a study's children: the best feasible one first, then the others, the smallest violation first."""
    parent = f"tags.mlflow.parentRunId = '{entry.run_id}'"
    order = [f"metrics.objective {'DESC' if entry.tags.get(GOAL) == MAXIMIZE else 'ASC'}"]
    runs = all_runs(open_store(uri), [entry.experiment_id], parent, order)
    entries = [_entry(run, run.data.tags.get("kind", "start"), entry.experiment) for run in runs]
    feasible = float(entry.params.get("optimizer.feasibility", FEASIBLE))
    violations = {child.run_id: child.metrics.get("violation", 0.0) for child in entries}
    return sorted(entries, key=lambda child: max(violations[child.run_id] - feasible, 0.0))


def history(uri: StoreURI | str, entry: Entry, metric: str) -> list[float]:
    """Return a metric of a run over its steps."""
    points = {point.step: point.value for point in open_store(uri).get_metric_history(entry.run_id, metric)}
    return [points[step] for step in sorted(points)]


def _entry(run: Any, kind: str, experiment: str) -> Entry:
    info = run.info
    seconds = None if info.end_time is None else (info.end_time - info.start_time) / 1000
    began = datetime.fromtimestamp(info.start_time / 1000)
    return Entry(
        experiment,
        info.experiment_id,
        info.run_id,
        info.run_name,
        kind,
        info.status,
        began,
        seconds,
        dict(run.data.metrics),
        dict(run.data.params),
        dict(run.data.tags),
    )
