"""The writer in a process of its own: what it writes is the same, Ctrl-C and kills included."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from torchmbd.tracking import MlflowTracker, TrackingError
from torchmbd.tracking.run_process import process_tag
from torchmbd.tracking.store import open_store


@pytest.fixture
def uri(tmp_path, empty_store):
    return f"sqlite:///{shutil.copy(empty_store, tmp_path)}"


@pytest.fixture
def tracker(uri, monkeypatch):
    """A tracker whose writer is a process, as where MLflow is not imported."""
    open_store(uri)
    monkeypatch.delitem(sys.modules, "mlflow")
    tracker = MlflowTracker("own", uri, "k")
    tracker.begin("study", "s")
    assert tracker._process is not None
    monkeypatch.undo()
    return tracker


def wait(until: Callable[[], object]) -> None:
    limit = time.monotonic() + 60.0
    while not until():
        assert time.monotonic() < limit
        time.sleep(0.05)


@pytest.mark.thorough
@pytest.mark.parametrize("when", ["while the study computes", "at the end"])
def test_a_writer_that_is_killed_is_started_again_and_writes_nothing_twice(tracker, uri, tmp_path, when):
    tracker.metrics("study", {"objective": 1.0}, 0)
    wait(lambda: tracker.record.runs)
    run, first = tracker.record.runs["study"], tracker._process
    first.kill()
    if when == "while the study computes":
        first.wait()
    tracker.metrics("study", {"objective": 0.5}, 1)
    tracker.artifact("study", tmp_path / "missing")
    tracker.end("study", "FINISHED")
    with pytest.raises(TrackingError, match="missing"):
        tracker.close()
    assert tracker._process is not first
    assert tracker.record.runs == {"study": run}
    client = open_store(uri)
    assert [(p.step, p.value) for p in client.get_metric_history(run, "objective")] == [(0, 1.0), (1, 0.5)]
    result = client.get_run(run)
    assert result.info.status == "FINISHED"
    assert result.data.tags["process"] == process_tag()  # of the study: it is this that may be killed


@pytest.mark.thorough
def test_what_the_store_says_is_said_here(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0")
    monkeypatch.delitem(sys.modules, "mlflow", raising=False)
    (tmp_path / "file").write_text("")
    tracker = MlflowTracker("own", f"sqlite:///{tmp_path / 'file' / 'runs.db'}")
    tracker.begin("study", "s")
    with pytest.raises(TrackingError, match=r"runs\.db.* cannot be opened"):
        tracker.close()


@pytest.mark.thorough
def test_lines_wait_until_the_disk_has_room(tracker, uri):
    """No file of this process may grow: it logs, is told why nothing reaches the store, and loses nothing."""
    import resource  # of POSIX

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    kept = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1, before[1]))
        tracker.metrics("study", {"objective": 1.0}, 0)
        assert "File too large" in tracker.trouble
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, kept)
    tracker.metrics("study", {"objective": 0.5}, 1)
    assert tracker.trouble is None
    run = tracker.close().runs["study"]
    history = open_store(uri).get_metric_history(run, "objective")
    assert [(p.step, p.value) for p in history] == [(0, 1.0), (1, 0.5)]


STUDY = """
import os, signal, sys, time
from torchmbd.tracking import MlflowTracker
tracker = MlflowTracker("own", sys.argv[1], "k")
tracker.begin("study", "s")
while not tracker.record.runs:
    time.sleep(0.01)
try:
    os.killpg(0, signal.SIGINT)  # as Ctrl-C does
    time.sleep(9.0)
except KeyboardInterrupt:
    tracker.metrics("study", {"objective": 2.0}, 0)
    print(tracker.close().runs["study"], "mlflow" in sys.modules)
"""


@pytest.mark.thorough
def test_ctrl_c_reaches_the_study_alone(uri):
    done = subprocess.run(
        [sys.executable, "-c", STUDY, uri], stdout=subprocess.PIPE, text=True, start_new_session=True, check=True
    )
    run, imported = done.stdout.split()
    assert imported == "False"  # MLflow is imported where it takes no time of the search
    result = open_store(uri).get_run(run)
    assert result.data.metrics == {"objective": 2.0}
    assert result.info.status == "KILLED"


@pytest.mark.thorough
def test_it_ends_with_its_study(uri):
    code = STUDY.replace("os.killpg(0, signal.SIGINT)", "print(tracker._process.pid, flush=True)")
    with subprocess.Popen([sys.executable, "-c", code, uri], stdout=subprocess.PIPE, text=True) as study:
        assert study.stdout is not None
        child = int(study.stdout.readline())
        os.kill(child, 0)
        study.send_signal(signal.SIGKILL)
    wait(lambda: not _lives(child))


def _lives(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat", encoding="utf-8") as file:
            return file.read().rpartition(") ")[2][0] != "Z"
    except OSError:
        return False
