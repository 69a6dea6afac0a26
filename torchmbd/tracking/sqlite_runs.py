"""Runs straight in the tables of MLflow's SQLite store: all of many runs in one transaction, and no MLflow imported.

MLflow's own calls write a run one call, several transactions and a dozen queries after the other, 40 ms for a start of 30
iterations, and importing it takes 1.5 s of a core that the study wants. Here that start takes 1 ms. Where this is not
possible the client does it (torchmbd.tracking.runs): a server, a database that is no SQLite file, tables of another MLflow
(`REVISION` is that of 3.17), files that are kept elsewhere than on this machine; and it makes the tables and experiments.

A run's id follows from the study's life and its key, its metrics lie at the times when they were told, and rows that are there
are left alone: a writer that is killed between its last transaction and noting it tells everything again, and nothing is there
twice.
Assumed: keys are words of torchmbd's own, which MLflow would accept.
Checked in tests/tracking/test_sqlite_runs.py: row by row beside MLflow's calls.
"""

from __future__ import annotations

import math
import shutil
import sqlite3
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from hashlib import sha256
from pathlib import Path

from torchmbd.tracking.runs import PROBE, Draft, Point

REVISION = "dc11669786a5"  # of the tables, in alembic_version
Row = tuple[str, str, float, int, int, int]  # of a metric: run, key, value, time, step, whether it is no number
_SECONDS = 20  # to wait for whoever else writes, as MLflow does
_MAX_TAG = 8000  # characters of a tag; MLflow cuts there
_RUN = """
insert or ignore into runs (run_uuid, name, source_type, source_name, entry_point_name, user_id, status, start_time,
    source_version, lifecycle_stage, artifact_uri, experiment_id)
values (?, ?, 'UNKNOWN', '', '', ?, 'RUNNING', ?, '', 'active', ?, ?)
"""
_TAG = """
insert into tags (run_uuid, key, value) values (?, ?, ?)
on conflict (key, run_uuid) do update set value = excluded.value
"""
_PARAM = "insert or ignore into params (run_uuid, key, value) values (?, ?, ?)"
_METRIC = "insert or ignore into metrics (run_uuid, key, value, timestamp, step, is_nan) values (?, ?, ?, ?, ?, ?)"
_LATEST = """
insert into latest_metrics (run_uuid, key, value, timestamp, step, is_nan) values (?, ?, ?, ?, ?, ?)
on conflict (key, run_uuid) do update
set value = excluded.value, timestamp = excluded.timestamp, step = excluded.step, is_nan = excluded.is_nan
where (excluded.step, excluded.timestamp, excluded.value) > (step, timestamp, value)
"""
_STATUS = "update runs set status = ?, end_time = coalesce(?, end_time) where run_uuid = ?"
_NOTE = """
insert into experiment_tags (experiment_id, key, value) values (?, ?, ?)
on conflict (key, experiment_id) do update set value = excluded.value
"""
_LEFT = """
select run_uuid from runs join tags as study using (run_uuid) join tags as run using (run_uuid)
where experiment_id = ? and lifecycle_stage = 'active' and study.key = 'study_key' and study.value = ?
    and run.key = 'run_key' and run.value = ? and (run_uuid = ? or status != 'FINISHED')
order by run_uuid = ? desc, start_time desc, run_uuid limit 1
"""
_CHILDREN = """
select own.value, run_uuid from tags as own join tags as parent using (run_uuid) join runs using (run_uuid)
where parent.key = 'mlflow.parentRunId' and parent.value = ? and own.key = 'run_key' and lifecycle_stage = 'active'
order by start_time desc, run_uuid
"""
_EXPERIMENT = """
select experiment_id, artifact_location from experiments
where name = ? and workspace = 'default' and lifecycle_stage = 'active'
"""


class SqliteRuns:
    """Keeps the contract of torchmbd.tracking.runs in one file."""

    repeatable = True

    def __init__(self, file: Path, experiment_id: str, location: Path) -> None:
        self.file, self.experiment_id, self._location = file, experiment_id, location

    @classmethod
    def of(cls, file: Path, experiment: str) -> SqliteRuns | None:
        """Return an experiment of a store; None where it is not there, or not such that this class may write it."""
        try:
            with _opened(file) as base:
                revisions = base.execute("select version_num from alembic_version").fetchall()
                found = base.execute(_EXPERIMENT, (experiment,)).fetchone() if revisions == [(REVISION,)] else None
        except sqlite3.Error:  # no store, none of MLflow's: whoever opens it by the client says what is wrong
            return None
        if found is None or not str(found[1]).startswith("/"):
            return None
        return cls(file, str(found[0]), Path(found[1]))

    def begin(self, unique: str, name: str, began: int, tags: dict[str, str]) -> Draft:
        """Return the draft of a run; the same words of `unique` make the same run."""
        return Draft(sha256(unique.encode()).hexdigest()[:32], name, began, tags=tags)

    def write(self, drafts: Sequence[Draft]) -> None:
        """All of it or nothing."""
        new = [draft for draft in drafts if draft.name is not None]
        names = [(draft.id, "mlflow.runName", _text(str(draft.name))) for draft in new]
        metrics = [_metric(draft.id, point) for draft in drafts for point in draft.metrics]
        with _opened(self.file) as base:
            base.executemany(_RUN, map(self._row, new))
            tags = [(d.id, key, _text(x[:_MAX_TAG])) for d in drafts for key, x in d.tags.items()]
            base.executemany(_TAG, tags + names)
            base.executemany(_PARAM, [(d.id, key, _text(x)) for d in drafts for key, x in d.params.items()])
            base.executemany(_METRIC, metrics)
            base.executemany(_LATEST, _latest(metrics))
            base.executemany(_STATUS, [(d.status, d.ended, d.id) for d in drafts if d.status is not None])

    def _row(self, draft: Draft) -> tuple[object, ...]:
        user = _text(draft.tags.get("mlflow.user", "unknown"))
        return draft.id, _text(str(draft.name)), user, draft.began, str(self._files(draft.id)), int(self.experiment_id)

    def _files(self, run_id: str) -> Path:
        return self._location / run_id / "artifacts"

    def artifact(self, run_id: str, file: Path, folder: str) -> None:
        there = self._files(run_id) / folder
        there.mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, there / file.name)

    def note(self, key: str, text: str) -> None:
        with _opened(self.file) as base:
            base.execute(_NOTE, (int(self.experiment_id), key, text))

    def left(self, study: str, run: str, root: str) -> str | None:
        """Return `root`, if the study has left it, or else one that has not finished; None if there is neither."""
        with _opened(self.file) as base:
            found = base.execute(_LEFT, (int(self.experiment_id), study, run, root, root)).fetchone()
        return None if found is None else found[0]

    def children(self, run_id: str) -> dict[str, str]:
        with _opened(self.file) as base:
            return dict(base.execute(_CHILDREN, (run_id,)).fetchall())

    def status(self, run_id: str) -> str:
        """Return the status of a run, "" for one that the store has refused or lost."""
        with _opened(self.file) as base:
            found = base.execute("select status from runs where run_uuid = ?", (run_id,)).fetchone()
        return "" if found is None else found[0]

    def probe(self) -> None:
        self.note(PROBE, str(time.time()))


@contextmanager
def _opened(file: Path) -> Iterator[sqlite3.Connection]:
    """A connection to a file that is there, for one transaction: a store that is moved away meanwhile is missed."""
    with closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True, timeout=_SECONDS)) as base, base:
        base.execute("pragma foreign_keys = on")
        yield base


def _text(text: str) -> str:
    """What can be written of a text: the name of a file may have bytes that are no characters."""
    return text.encode(errors="replace").decode()


def _metric(run_id: str, point: Point) -> Row:
    """A row of `metrics`: what is no number, or infinite, as MLflow keeps it."""
    nan = math.isnan(point.value)
    value = 0.0 if nan else min(max(point.value, -sys.float_info.max), sys.float_info.max)
    return run_id, point.key, value, point.when, point.step, int(nan)


def _latest(rows: Sequence[Row]) -> list[Row]:
    """The last row of every metric of every run, by step, time and value."""
    last: dict[tuple[str, str], Row] = {}
    for row in rows:
        run_id, key, value, when, step, _ = row
        known = last.get((run_id, key))
        if known is None or (step, when, value) > (known[4], known[3], known[2]):
            last[run_id, key] = row
    return list(last.values())
