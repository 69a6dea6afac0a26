"""What a store holds: the studies so far, the newest first."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from torchmbd.tracking.store import open_store, sqlite_file

_PAGE = 1000  # runs that are listed at most


@dataclass(frozen=True)
class Entry:
    """One study of a store."""

    experiment: str
    experiment_id: str
    run_id: str
    name: str
    kind: str  # "study" or "sweep"
    status: str
    began: datetime
    seconds: float | None  # None while it runs
    metrics: dict[str, float]


def studies(uri: str) -> list[Entry]:
    """Return the parent runs of a store; a SQLite file that does not exist holds none and is not created."""
    file = sqlite_file(uri)
    if file is not None and not file.exists():
        return []
    client = open_store(uri)
    names = {e.experiment_id: e.name for e in client.search_experiments()}
    found = []
    for kind in ("study", "sweep"):
        runs = client.search_runs(list(names), f"tags.kind = '{kind}'", max_results=_PAGE) if names else []
        found += [_entry(run, kind, names[run.info.experiment_id]) for run in runs]
    return sorted(found, key=lambda entry: entry.began, reverse=True)


def children(uri: str, entry: Entry) -> list[str]:
    """Return the run ids of a study's children, the best objective first."""
    parent = f"tags.mlflow.parentRunId = '{entry.run_id}'"
    runs = open_store(uri).search_runs(
        [entry.experiment_id], parent, max_results=_PAGE, order_by=["metrics.objective ASC"]
    )
    return [run.info.run_id for run in runs]


def _entry(run: Any, kind: str, experiment: str) -> Entry:
    info = run.info
    seconds = None if info.end_time is None else (info.end_time - info.start_time) / 1000
    began = datetime.fromtimestamp(info.start_time / 1000)
    name = info.run_name
    return Entry(
        experiment, info.experiment_id, info.run_id, name, kind, info.status, began, seconds, dict(run.data.metrics)
    )
