"""The contract of tracking, run by every tracker against a real SQLite store, read back by MlflowClient."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from torchmbd.numerics.build_cache import entries
from torchmbd.tracking import ProcessTracker, TrackingError
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store, store_uri

TRACKERS = [MlflowTracker, ProcessTracker]


def made(tracker_type, experiment: str, uri: str, folder: Path):
    return MlflowTracker(experiment, uri) if tracker_type is MlflowTracker else ProcessTracker(experiment, uri, folder)


@pytest.fixture(scope="module")
def uri(tmp_path_factory, empty_store):
    return f"sqlite:///{shutil.copy(empty_store, tmp_path_factory.mktemp('store'))}"


@pytest.mark.parametrize("tracker_type", TRACKERS)
def test_what_is_told_is_read_back(tracker_type, uri, tmp_path):
    picture = tmp_path / "a.txt"
    picture.write_text("picture")
    tracker = made(tracker_type, f"contract-{tracker_type.__name__}", uri, tmp_path / "study")
    tracker.begin("study", "L3", params={"options.layers": 3}, tags={"kind": "study"})
    tracker.begin("start_1", "start 1", parent="study")
    for step in range(1200):  # more than one batch of MLflow's
        tracker.metrics("start_1", {"objective": 1.0 / (step + 1), "angle_1_deg": 45.0 - step}, step)
    tracker.tags("start_1", {"status": "converged"})
    tracker.artifact("study", picture, "figures")
    tracker.end("start_1", "FINISHED")
    tracker.end("study", "FINISHED")
    record = tracker.close()

    client = open_store(uri)
    parent, child = (client.get_run(record.runs[key]) for key in ("study", "start_1"))
    assert parent.info.experiment_id == child.info.experiment_id == record.experiment_id
    assert parent.data.params == {"options.layers": "3"}
    assert child.data.tags["mlflow.parentRunId"] == record.runs["study"]
    assert child.data.tags["status"] == "converged"
    history = client.get_metric_history(record.runs["start_1"], "objective")
    assert {point.step: point.value for point in history} == {step: 1.0 / (step + 1) for step in range(1200)}
    assert parent.info.status == child.info.status == "FINISHED"
    assert (Path(parent.info.artifact_uri) / "figures" / "a.txt").read_text() == "picture"
    assert Path(parent.info.artifact_uri).is_relative_to(Path(uri.removeprefix("sqlite:///")).parent / "mlartifacts")


@pytest.mark.parametrize("tracker_type", TRACKERS)
def test_what_is_left_open_is_killed(tracker_type, uri, tmp_path):
    tracker = made(tracker_type, "open", uri, tmp_path / "study")
    tracker.begin("study", "s")
    tracker.begin("start_0", "s0", parent="study")
    tracker.begin("start_1", "s1", parent="study")
    tracker.metrics("start_1", {"objective": 2.0}, 0)
    tracker.end("start_0", "FAILED")
    record = tracker.close()
    client = open_store(uri)
    status = {key: client.get_run(run).info.status for key, run in record.runs.items()}
    assert status == {"study": "KILLED", "start_0": "FAILED", "start_1": "KILLED"}
    assert client.get_run(record.runs["start_1"]).data.metrics == {"objective": 2.0}


@pytest.mark.parametrize(
    ("tracker_type", "bad", "message"),
    [
        (MlflowTracker, lambda tracker: tracker.metrics("missing", {"objective": 1.0}), "'missing' has not begun"),
        (MlflowTracker, lambda tracker: tracker.begin("study", "again"), "has begun already"),
        (MlflowTracker, lambda tracker: tracker.artifact("study", "/does/not/exist"), "does/not/exist"),
        (ProcessTracker, lambda tracker: tracker.artifact("study", "/does/not/exist"), "does/not/exist"),
    ],
)
def test_what_cannot_be_written_is_an_error(tracker_type, uri, bad, message, tmp_path):
    tracker = made(tracker_type, "errors", uri, tmp_path / "study")
    tracker.begin("study", "s")

    def tell_and_close():
        bad(tracker)
        tracker.close()

    with pytest.raises((TrackingError, OSError), match=message):
        tell_and_close()


@pytest.mark.parametrize("tracker_type", TRACKERS)
def test_a_store_that_cannot_be_opened_is_named(tracker_type, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0.2")
    (tmp_path / "file").write_text("")
    bad = f"sqlite:///{tmp_path / 'file' / 'runs.db'}"

    def use():
        tracker = made(tracker_type, "x", bad, tmp_path / "study")
        tracker.begin("study", "s")
        tracker.close()

    with pytest.raises(TrackingError, match=r"runs\.db"):
        use()


def test_a_deleted_experiment_is_named(uri):
    MlflowTracker("gone", uri).close()
    client = open_store(uri)
    client.delete_experiment(client.get_experiment_by_name("gone").experiment_id)
    with pytest.raises(TrackingError, match="'gone' is deleted"):
        MlflowTracker("gone", uri)


STUDY = """
import sys, time
from pathlib import Path
from torchmbd.tracking import ProcessTracker
if __name__ == "__main__":
    tracker = ProcessTracker("killed", sys.argv[1], Path(sys.argv[2]))
    tracker.begin("study", "s")
    tracker.begin("start_0", "s0", parent="study")
    tracker.metrics("start_0", {"objective": 3.0}, 0)
    print("told", flush=True)
    time.sleep(60)
"""


def test_a_study_that_is_killed_leaves_no_run_running(tmp_path, empty_store):
    """kill -9: no handler runs in the study; its writer sees the pipe close."""
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    MlflowTracker("killed", uri).close()
    study = subprocess.Popen(
        [sys.executable, "-c", STUDY, uri, str(tmp_path / "study")], stdout=subprocess.PIPE, text=True
    )
    assert study.stdout is not None
    assert study.stdout.readline() == "told\n"
    os.kill(study.pid, signal.SIGKILL)
    study.wait()
    study.stdout.close()
    client = open_store(uri)
    experiment = client.get_experiment_by_name("killed").experiment_id
    for _ in range(300):
        runs = client.search_runs([experiment])
        if len(runs) == 2 and all(run.info.end_time for run in runs):
            break
        time.sleep(0.1)
    assert sorted(run.info.status for run in runs) == ["KILLED", "KILLED"]
    assert any(run.data.metrics == {"objective": 3.0} for run in runs)


@pytest.mark.slow
def test_two_studies_open_a_fresh_store_at_once(tmp_path):
    """Without the lock MLflow's migration crashes one of them, or the experiment is made twice."""
    uri = f"sqlite:///{tmp_path / 'runs.db'}"
    trackers = [ProcessTracker("same", uri, tmp_path / f"study_{k}") for k in range(2)]
    for tracker in trackers:
        tracker.begin("study", "s")
    records = [tracker.close() for tracker in trackers]
    assert records[0].experiment_id == records[1].experiment_id
    assert records[0].runs["study"] != records[1].runs["study"]


def test_a_study_that_says_nothing_creates_no_store(tmp_path):
    ProcessTracker("silent", f"sqlite:///{tmp_path / 'runs.db'}", tmp_path / "study").close()
    assert not list(tmp_path.iterdir())


def test_stores_leave_one_lock_for_all(tmp_path, empty_store, monkeypatch):
    for name in ("TMPDIR", "TORCHMBD_CACHE"):
        monkeypatch.setenv(name, str(tmp_path / name))
        (tmp_path / name).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "TMPDIR"))
    for k in range(2):
        (tmp_path / f"{k}").mkdir()
        MlflowTracker("own", f"sqlite:///{shutil.copy(empty_store, tmp_path / f'{k}')}").close()
    assert not list((tmp_path / "TMPDIR").iterdir())
    assert [file.name for file in (tmp_path / "TORCHMBD_CACHE").iterdir()] == ["stores.lock"]
    assert not entries()  # torchmbd cache lists libraries


def test_the_default_store(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    assert store_uri() == f"sqlite:///{tmp_path / 'mlflow.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://localhost:1")
    assert store_uri() == "http://localhost:1"
    assert store_uri("sqlite:///there.db") == f"sqlite:///{tmp_path / 'there.db'}"
