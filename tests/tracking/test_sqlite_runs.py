"""Rows that are written straight into MLflow's tables, beside those that MLflow's own calls write."""

from __future__ import annotations

import json
import math
import os
import shutil
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from torchmbd.bare import command
from torchmbd.tracking import mlflow_tracker
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.runs import ClientRuns, open_runs
from torchmbd.tracking.spool import Journal
from torchmbd.tracking.sqlite_runs import REVISION, SqliteRuns
from torchmbd.tracking.store import experiment_id, open_store
from torchmbd.tracking.writer import Writer

TABLES = ("experiments", "experiment_tags", "runs", "tags", "params", "metrics", "latest_metrics")


def by_client(uri: str, experiment: str) -> ClientRuns:
    client = open_store(uri)
    return ClientRuns(client, experiment_id(client, experiment, uri))


def rows(uri: str, names: dict[str, str]) -> dict[str, list]:
    """All rows of a store in order, run ids replaced by the keys of the runs, and the store's folder by a word."""
    file = Path(uri.removeprefix("sqlite:///"))
    found = {}
    with closing(sqlite3.connect(file)) as base:
        for table in TABLES:
            cursor = base.execute(f"select * from {table}")
            columns = [column[0] for column in cursor.description]
            data = [dict(zip(columns, row, strict=True)) for row in cursor]
            for row in data:
                for column, value in row.items():
                    if column in ("creation_time", "last_update_time"):
                        row[column] = None
                    elif isinstance(value, str):
                        for key, run_id in names.items():
                            value = value.replace(run_id, key)
                        row[column] = value.replace(str(file.parent), "HERE")
            found[table] = sorted(data, key=str)
    return found


def life(tracker: MlflowTracker, when: int, study: str = "study") -> MlflowTracker:
    """A study with all that may happen to its runs."""
    tracker.when = when
    tracker.begin(study, "L3", params={"layers": 3, "long": "x" * 7000}, tags={"kind": "study", "mlflow.user": "ada"})
    tracker.view(study, ["metrics.objective"], "metrics.objective")
    for k in range(3):
        tracker.when = when + 10 * (k + 1)
        tracker.begin(f"start_{k}", f"start {k}", parent=study, params={"start": k}, tags={"kind": "start"})
        for step in (0, 2, 1, 1):
            tracker.metrics(f"start_{k}", {"objective": 1.0 / (step + 1), "angle_1_deg": -45.0 * step}, step)
    tracker.metrics("start_0", {"odd": math.nan, "large": math.inf, "small": -math.inf, "tie": 1.0}, 3)
    tracker.metrics("start_0", {"odd": 1.0, "tie": 0.5}, 3)
    tracker.flush()
    tracker.when = when + 100
    tracker.metrics("start_1", {"objective": 0.1, "odd": math.nan}, 5)
    tracker.metrics("start_2", {"objective": 7.0}, 0)  # later, of an earlier step
    tracker.tags("start_1", {"kind": "other", "message": "m" * 9000})
    tracker.end("start_0", "FAILED")
    tracker.flush()
    tracker.tags("start_0", {"message": "after its end"})
    tracker.end("start_1", "FINISHED")
    tracker.end("start_2", "FINISHED")
    tracker.end(study, "FINISHED")
    tracker.close()
    return tracker


def test_the_rows_are_those_of_mlflow(tmp_path, empty_store, monkeypatch):
    found = []
    for name, how in (("mlflow", by_client), ("straight", open_runs)):
        (tmp_path / name).mkdir()
        uri = f"sqlite:///{shutil.copy(empty_store, tmp_path / name)}"
        monkeypatch.setattr(mlflow_tracker, "open_runs", how)
        tracker = MlflowTracker("rows", uri, "k")
        tracker.when = 500
        tracker.begin("study", "L3")
        tracker.begin("start_1", "start 1", parent="study")
        tracker.metrics("start_1", {"objective": 1.0}, 0)
        first = tracker.close().runs  # killed; the next life goes on with these
        second = life(MlflowTracker("rows", uri, "k", steps=tracker.steps), 1000)
        assert first.items() <= second.runs.items()
        found.append(rows(uri, second.runs))
        assert isinstance(second.store, ClientRuns if how is by_client else SqliteRuns)
    for table in TABLES:
        assert found[1][table] == found[0][table], table
    assert len(found[0]["metrics"]) > 20


def test_what_is_told_twice_is_there_once(tmp_path, empty_store):
    """A writer that is killed behind its last transaction leaves no note of it."""
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    first = life(MlflowTracker("twice", uri, "k", life="1"), 1000)
    before = rows(uri, first.runs)
    again = life(MlflowTracker("twice", uri, "k", life="1"), 1000)
    assert again.runs == first.runs
    assert rows(uri, first.runs) == before
    other = life(MlflowTracker("twice", uri, "k", life="2"), 1000)
    assert not set(other.runs.values()) & set(first.runs.values())


def test_the_tables_are_those_of_this_mlflow(empty_store):
    with closing(sqlite3.connect(empty_store)) as base:
        assert base.execute("select version_num from alembic_version").fetchall() == [(REVISION,)]


def test_tables_of_another_mlflow_are_left_to_it(tmp_path, empty_store):
    file = Path(shutil.copy(empty_store, tmp_path))
    uri = f"sqlite:///{file}"
    assert isinstance(open_runs(uri, "own"), SqliteRuns)
    client = open_store(uri)
    client.create_experiment("elsewhere", artifact_location="s3://bucket/files")
    assert isinstance(open_runs(uri, "elsewhere"), ClientRuns)
    with closing(sqlite3.connect(file)) as base, base:
        base.execute("update alembic_version set version_num = 'another'")
    assert SqliteRuns.of(file, "own") is None


def test_a_store_that_was_moved_away_is_missed(tmp_path, empty_store):
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    tracker = MlflowTracker("moved", uri)
    tracker.begin("study", "s")
    (tmp_path / "runs.db").rename(tmp_path / "elsewhere.db")
    with pytest.raises(sqlite3.OperationalError):
        tracker.flush()
    (tmp_path / "elsewhere.db").rename(tmp_path / "runs.db")
    run = tracker.close().runs["study"]
    assert open_store(uri).get_run(run).info.status == "KILLED"


def told(folder: Path, uri: str, step: int, tag: str = "") -> Path:
    """A journal with a metric that SQLite refuses if its step is too large."""
    journal = Journal(folder, ["session", "own", uri, "k"])
    journal.append(["begin", "study", "s", None, {}, {"file": tag}])
    journal.append(["metrics", "study", {"objective": 1.0}, step])
    journal.append(["end", "study", "FINISHED"])
    journal.close()
    return journal.file


def test_a_run_that_is_refused_is_named(tmp_path, empty_store):
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    word = Writer(tmp_path / "study", told(tmp_path / "study", uri, 2**63), lambda: True).run()
    assert "too large" in word["refused"][0]
    assert not word["finished"]


def test_what_is_refused_of_a_run_is_refused_once_and_dropped(tmp_path, empty_store):
    """Kept, it would be refused again with all that is told of the run later."""
    folder, uri = tmp_path / "study", f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    journal = Journal(folder, ["session", "own", uri, "k"])
    journal.append(["begin", "study", "s", None, {}, {}])
    journal.append(["begin", "start_0", "s0", "study", {}, {}])
    told = [
        [["metrics", "start_0", {"objective": 1.0}, 2**63]],
        [["metrics", "start_0", {"objective": 2.0}, 1], ["end", "start_0", "FINISHED"], ["end", "study", "FINISHED"]],
        [],
    ]
    asked = iter(range(99))

    def over():  # asked before every look at the journal
        when = next(asked)
        for line in told[when - 1] if 0 < when <= len(told) else []:
            journal.append(line)
        return when >= len(told)

    word = Writer(folder, journal.file, over, lambda: True).run()
    assert [text.partition(":")[0] for text in word["refused"]] == ["what was told of start_0"]
    runs = {name: open_store(uri).get_run(run) for name, run in word["runs"].items()}
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    assert runs["start_0"].data.metrics == {"objective": 2.0}


def test_bytes_that_are_no_characters_cost_nothing(tmp_path, empty_store):
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    word = Writer(tmp_path / "study", told(tmp_path / "study", uri, 0, "a\udcff.yaml"), lambda: True).run()
    assert not word["refused"]
    assert open_store(uri).get_run(word["runs"]["study"]).data.tags["file"] == "a?.yaml"


def test_a_store_that_was_locked_for_a_while_loses_nothing(tmp_path, empty_store, monkeypatch):
    """Whoever else wrote is gone when the store is asked: what was to be written waits nevertheless."""
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    own, left = SqliteRuns.write, [4]

    def write(self, drafts):
        if left[0]:
            left[0] -= 1
            raise sqlite3.OperationalError("database is locked")
        own(self, drafts)

    monkeypatch.setattr(SqliteRuns, "write", write)
    word = Writer(tmp_path / "study", told(tmp_path / "study", uri, 0), lambda: True).run()
    assert not word["refused"]
    assert open_store(uri).get_run(word["runs"]["study"]).info.status == "FINISHED"


def test_a_writer_does_without_mlflow_where_the_experiment_is_there(tmp_path, empty_store):
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    MlflowTracker("own", uri)
    journal = Journal(tmp_path / "study", ["session", "own", uri, "k"])
    journal.append(["begin", "study", "s", None, {}, {}])
    journal.append(["end", "study", "FINISHED"])
    journal.close()
    (tmp_path / "mlflow.py").write_text("raise ImportError")
    order = command("torchmbd.tracking.writer", str(tmp_path / "study"))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    answer = subprocess.run(
        order, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True
    )
    word = json.loads(answer.stdout)
    assert not word["refused"]
    assert open_store(uri).get_run(word["runs"]["study"]).info.status == "FINISHED"
