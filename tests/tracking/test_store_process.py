"""A store in a process of its own: what it writes is the same, Ctrl-C and kills included."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from torchmbd.tracking import MlflowTracker, TrackingError
from torchmbd.tracking.run_process import process_tag
from torchmbd.tracking.store import open_store
from torchmbd.tracking.store_process import StoreProcess
from torchmbd.tracking.study_store import PendingRun, Point


@pytest.fixture
def uri(tmp_path, empty_store):
    return f"sqlite:///{shutil.copy(empty_store, tmp_path)}"


def process(uri: str) -> StoreProcess:
    tracker = MlflowTracker("own", uri, "k")
    return StoreProcess(tracker.experiment, tracker.uri, tracker.study)


def begun(step: int = 0) -> PendingRun:
    """A draft of a run with a metric at a step."""
    return PendingRun("study", 1, metrics=[Point("objective", 1.0 / (step + 1), 10 + step, step)])


@pytest.mark.thorough
def test_a_process_that_is_killed_is_started_again_and_writes_nothing_twice(uri, tmp_path):
    own = process(uri)
    own.write("study", begun())
    run, first = own.ids["study"], own._process
    assert first is not None
    assert own.processor_time() > 0.0
    first.kill()
    with pytest.raises(TrackingError, match="the process that writes ended with"):
        own.write("study", PendingRun(metrics=[*begun().metrics, *begun(1).metrics]))
    draft = PendingRun(metrics=[*begun().metrics, *begun(1).metrics], artifacts=[(tmp_path / "missing", "")])
    draft.ended = "FINISHED", 20
    own.write("study", draft)
    assert own.ids == {"study": run}
    assert "missing" in own.refused[0]
    own.close()
    client = open_store(uri)
    assert [(p.step, p.value) for p in client.get_metric_history(run, "objective")] == [(0, 1.0), (1, 0.5)]
    result = client.get_run(run)
    assert result.info.status == "FINISHED"
    assert result.data.tags["process"] == process_tag()  # of the study: it is this that may be killed


@pytest.mark.thorough
def test_what_the_store_says_is_said_here(tmp_path):
    (tmp_path / "file").write_text("")
    own = process(f"sqlite:///{tmp_path / 'file' / 'runs.db'}")
    with pytest.raises(TrackingError, match=r"runs\.db.* cannot be opened"):
        own.opened()
    own.close()


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
    code = STUDY.replace("os.killpg(0, signal.SIGINT)", "print(tracker._store._process.pid, flush=True)")
    with subprocess.Popen([sys.executable, "-c", code, uri], stdout=subprocess.PIPE, text=True) as study:
        assert study.stdout is not None
        child = int(study.stdout.readline())
        os.kill(child, 0)
        study.send_signal(signal.SIGKILL)
    until = time.monotonic() + 20.0
    while _lives(child):
        assert time.monotonic() < until
        time.sleep(0.05)


def _lives(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat", encoding="utf-8") as file:
            return file.read().rpartition(") ")[2][0] != "Z"
    except OSError:
        return False
