"""The contract of tracking, kept against a real SQLite store, read back by MlflowClient."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from torchmbd.integrate.backend import BACKENDS
from torchmbd.tracking import MlflowTracker, TrackingError
from torchmbd.tracking.catalog import children, find, studies
from torchmbd.tracking.store import open_store, store_uri


@pytest.fixture
def uri(tmp_path, empty_store):
    (tmp_path / "store").mkdir()
    return f"sqlite:///{shutil.copy(empty_store, tmp_path / 'store')}"


def hide(tmp_path: Path) -> None:
    """Put a file where the store's folder should be: it cannot be opened until it is shown again."""
    (tmp_path / "store").rename(tmp_path / "hidden")
    (tmp_path / "store").write_text("")


def show(tmp_path: Path) -> None:
    (tmp_path / "store").unlink()
    (tmp_path / "hidden").rename(tmp_path / "store")


def points(uri: str, run_id: str, key: str = "objective") -> list[tuple[int, float]]:
    return sorted((p.step, p.value) for p in open_store(uri).get_metric_history(run_id, key))


def runs(uri: str) -> list:
    client = open_store(uri)
    return client.search_runs([e.experiment_id for e in client.search_experiments()])


@pytest.mark.thorough
def test_what_is_logged_is_read_back(uri, tmp_path):
    picture = tmp_path / "a.txt"
    picture.write_text("picture")
    before = int(1000 * time.time())
    tracker = MlflowTracker("contract", uri)
    tracker.begin("study", "L3", params={"options.layers": 3, "long": "x" * 7000}, tags={"kind": "study"})
    tracker.begin("start_1", "start 1", parent="study", params={f"p{k}": k for k in range(250)})
    for step in range(1200):  # more than one batch of MLflow's
        tracker.metrics("start_1", {"objective": 1.0 / (step + 1), "angle_1_deg": 45.0 - step}, step)
    tracker.metrics("start_1", {"objective": 0.5}, 1199)  # a result at the step of the last iterate
    tracker.tags("start_1", {"status": "converged"})
    tracker.artifact("study", picture, "figures")
    tracker.end("start_1", "FINISHED")
    tracker.end("study", "FINISHED")
    logged = int(1000 * time.time())
    record = tracker.close()

    client = open_store(uri)
    parent, child = (client.get_run(record.runs[key]) for key in ("study", "start_1"))
    assert parent.info.experiment_id == child.info.experiment_id == record.experiment_id
    assert parent.data.params == {"options.layers": "3", "long": "x" * 6000}
    assert len(child.data.params) == 250
    assert child.data.tags["mlflow.parentRunId"] == record.runs["study"]
    assert (child.data.tags["status"], parent.data.tags["kind"]) == ("converged", "study")
    history = client.get_metric_history(record.runs["start_1"], "objective")
    assert {point.step: point.value for point in history[:-1]} == {step: 1.0 / (step + 1) for step in range(1200)}
    assert child.data.metrics["objective"] == 0.5
    assert parent.info.status == child.info.status == "FINISHED"
    times = [parent.info.start_time, child.info.start_time, child.info.end_time, parent.info.end_time]
    assert sorted([before, *times, logged]) == [before, *times, logged]  # when it was logged, not when it was sent
    assert tracker.seconds == pytest.approx((times[-1] - times[0]) / 1000, abs=0.01)  # one duration for all who ask
    files = tmp_path / "store" / "mlartifacts" / record.runs["study"] / "artifacts"
    assert (files / "figures" / "a.txt").read_text() == "picture"
    assert parent.info.artifact_uri == f"mlflow-artifacts:/{record.runs['study']}/artifacts"  # where its server has it
    assert parent.data.tags["files"] == "figures/a.txt"


def test_what_is_left_open_is_killed(uri):
    tracker = MlflowTracker("open", uri)
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


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (lambda tracker: tracker.metrics("missing", {"objective": 1.0}), "'missing' has not begun"),
        (lambda tracker: tracker.begin("start_0", "s", parent="missing"), "'missing' has not begun"),
        (lambda tracker: tracker.begin("study", "again"), "has begun already"),
    ],
)
def test_what_cannot_be_logged_is_an_error(uri, bad, message):
    tracker = MlflowTracker("errors", uri)
    tracker.begin("study", "s")
    with pytest.raises(TrackingError, match=message):
        bad(tracker)
    tracker.close()


@pytest.mark.thorough
def test_what_the_store_refuses_is_named_and_holds_nothing_up(uri):
    tracker = MlflowTracker("refused", uri)
    tracker.begin("study", "s")
    tracker.artifact("study", "/does/not/exist")
    tracker.begin("start_0", "s", "study", params={"no|key": 1})
    tracker.metrics("study", {"objective": 2.0}, 0)
    tracker.end("start_0", "FINISHED")
    tracker.end("study", "FINISHED")
    with pytest.raises(TrackingError, match="does/not/exist") as caught:
        tracker.close()
    assert "no|key" in str(caught.value)
    result = runs(uri)
    assert [run.info.status for run in result] == ["FINISHED"] * 2
    assert any(run.data.metrics == {"objective": 2.0} for run in result)


@pytest.mark.parametrize(
    ("params", "metrics", "told"),
    [
        ({"unit": "m"}, {}, ["unit"]),  # of the process before it was mm
        ({}, {"constraint/" + "long " * 60: 0.5}, ["250"]),
        ({"no|key": "1"}, {"no|metric": 0.5, "design/50% ply": 1.0}, ["no|key", "no|metric", "50% ply"]),
    ],
    ids=["param", "long metric", "several"],
)
def test_what_the_store_refuses_takes_nothing_else_with_it(uri, params, metrics, told):
    first = MlflowTracker("refused", uri, "k")
    first.begin("study", "s", params={"unit": "mm"})
    first.close()
    tracker = MlflowTracker("refused", uri, "k")
    tracker.begin("study", "s", params={"size": "1"} | params, tags={"kept": "yes"})
    for step in range(7):
        tracker.metrics("study", {"objective": 1.0 / (step + 1)} | (metrics if step == 3 else {}), step)
    tracker.end("study", "FINISHED")
    with pytest.raises(TrackingError) as caught:
        tracker.close()
    assert all(word in str(caught.value) for word in told)
    [run] = runs(uri)
    assert (run.data.params, run.data.tags["kept"]) == ({"unit": "mm", "size": "1"}, "yes")
    assert points(uri, run.info.run_id) == [(step, 1.0 / (step + 1)) for step in range(7)]


@pytest.mark.thorough
def test_a_store_that_cannot_be_opened_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0.2")
    (tmp_path / "file").write_text("")
    tracker = MlflowTracker("x", f"sqlite:///{tmp_path / 'file' / 'runs.db'}")
    tracker.begin("study", "s")
    with pytest.raises(TrackingError, match=r"runs\.db"):
        tracker.close()


@pytest.mark.thorough
def test_a_deleted_experiment_is_named(uri, monkeypatch):
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0")
    for life in range(2):
        tracker = MlflowTracker("gone", uri)
        tracker.begin("study", "s")
        if life == 0:
            open_store(uri).delete_experiment(tracker.close().experiment_id)
    with pytest.raises(TrackingError, match="'gone' is deleted"):
        tracker.close()


@pytest.mark.thorough
def test_a_store_that_is_away_is_caught_up_with(uri, tmp_path):
    """The study goes on; what it tells meanwhile is there in the end."""
    hide(tmp_path)
    tracker = MlflowTracker("away", uri)
    tracker.begin("study", "s")
    while tracker.trouble is None:
        time.sleep(0.01)
    assert "runs.db" in tracker.trouble
    began = time.monotonic()
    for step in range(50):
        tracker.metrics("study", {"objective": 3.0 / (step + 1)}, step)
    tracker.end("study", "FINISHED")
    assert time.monotonic() - began < 1.0
    back = threading.Timer(1.0, show, [tmp_path])
    back.start()
    record = tracker.close()
    assert [step for step, _ in points(uri, record.runs["study"])] == list(range(50))
    assert [run.info.status for run in runs(uri)] == ["FINISHED"]


@pytest.mark.thorough
def test_a_store_that_another_process_writes_is_waited_for(uri):
    other = sqlite3.connect(uri.removeprefix("sqlite:///"), check_same_thread=False, isolation_level=None)
    tracker = MlflowTracker("locked", uri)
    tracker.begin("study", "s")
    tracker.metrics("study", {"objective": 1.0}, 0)
    other.execute("begin immediate")
    free = threading.Timer(3.0, other.execute, ["rollback"])
    free.start()
    tracker.end("study", "FINISHED")
    record = tracker.close()
    free.join()
    other.close()
    assert points(uri, record.runs["study"]) == [(0, 1.0)]
    assert [run.info.status for run in runs(uri)] == ["FINISHED"]


LIFE = """
import os, signal, sys, time
from torchmbd.tracking import MlflowTracker
tracker = MlflowTracker("killed", sys.argv[1], "k")
tracker.begin("study", "s", params={"layers": 3})
tracker.begin("start_0", "start 0", parent="study")
for step in range(4):
    tracker.metrics("start_0", {"objective": 1.0 / (step + 1)}, step)
while len(tracker.record.runs) < 2:
    time.sleep(0.01)
time.sleep(1.0)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.thorough
def test_a_study_that_was_killed_goes_on_in_its_runs(uri):
    """kill -9 leaves runs RUNNING: the next life ends them, and writes nothing twice."""
    subprocess.run([sys.executable, "-c", LIFE, uri], check=False)
    left = {run.info.run_id: run.info.status for run in runs(uri)}
    assert list(left.values()) == ["RUNNING"] * 2
    tracker = MlflowTracker("killed", uri, "k")
    tracker.begin("study", "s", params={"layers": 3})
    tracker.begin("start_0", "start 0", parent="study")
    for step in range(6):
        tracker.metrics("start_0", {"objective": 1.0 / (step + 1)}, step)
    tracker.metrics("start_0", {"objective": 0.01}, 5)
    tracker.end("start_0", "FINISHED")
    tracker.end("study", "FINISHED")
    record = tracker.close()
    assert set(record.runs.values()) == set(left)
    assert {run.info.status for run in runs(uri)} == {"FINISHED"}
    assert points(uri, record.runs["start_0"]) == sorted([(k, 1.0 / (k + 1)) for k in range(6)] + [(5, 0.01)])
    assert open_store(uri).get_run(record.runs["start_0"]).data.metrics["objective"] == 0.01
    other = MlflowTracker("killed", uri)
    other.begin("study", "s")
    assert not set(other.close().runs.values()) & set(left)


@pytest.mark.slow
def test_runs_beyond_one_page_are_found(uri, monkeypatch):
    """Studies, starts, and those of an earlier process of the same study."""
    monkeypatch.setattr("torchmbd.tracking.store._PAGE", 2)
    records = []
    for study in ("x", "y", "z", "z"):  # no run id begins with these
        tracker = MlflowTracker("pages", uri, study)
        tracker.begin("study", study, tags={"kind": "study"})
        for k in range(5):
            tracker.begin(f"start_{k}", f"start {k}", parent="study", tags={"kind": "start"})
            tracker.metrics(f"start_{k}", {"objective": float(k)})
        records.append(tracker.close())
    assert {entry.name for entry in studies(uri)} == {"x", "y", "z"}
    assert find(uri, "x").run_id == records[0].runs["study"]
    assert [child.name for child in children(uri, find(uri, "x"))] == [f"start {k}" for k in range(5)]
    assert records[2].runs == records[3].runs


@pytest.mark.thorough
def test_two_studies_open_a_fresh_store_at_once(tmp_path):
    """Without the lock MLflow's migration crashes one of them, or the experiment is made twice."""
    uri = f"sqlite:///{tmp_path / 'runs.db'}"
    life = "import sys; from torchmbd.tracking import MlflowTracker; t = MlflowTracker('same', sys.argv[1])\n"
    life += "t.begin('study', 's'); r = t.close(); print(r.experiment_id, r.runs['study'])"
    both = [subprocess.Popen([sys.executable, "-c", life, uri], stdout=subprocess.PIPE, text=True) for _ in range(2)]
    result = [process.communicate()[0].split() for process in both]
    assert result[0][0] == result[1][0]
    assert result[0][1] != result[1][1]


def test_a_study_that_says_nothing_creates_no_store(tmp_path):
    MlflowTracker("silent", f"sqlite:///{tmp_path / 'runs.db'}").close()
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough
def test_stores_leave_one_lock_for_all(tmp_path, empty_store, monkeypatch):
    for name in ("TMPDIR", "TORCHMBD_CACHE"):
        monkeypatch.setenv(name, str(tmp_path / name))
        (tmp_path / name).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "TMPDIR"))
    for k in range(2):
        (tmp_path / f"{k}").mkdir()
        tracker = MlflowTracker("own", f"sqlite:///{shutil.copy(empty_store, tmp_path / f'{k}')}")
        tracker.begin("study", "s")
        tracker.close()
    assert not list((tmp_path / "TMPDIR").iterdir())
    assert [file.name for file in (tmp_path / "TORCHMBD_CACHE").iterdir()] == ["stores.lock"]
    assert not [file for backend in BACKENDS.values() for file in backend().files()]  # torchmbd cache lists libraries


def test_the_default_store(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    assert str(store_uri()) == f"sqlite:///{tmp_path / 'mlflow.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://localhost:1")
    assert str(store_uri()) == "http://localhost:1"
    assert str(store_uri("sqlite:///there.db")) == f"sqlite:///{tmp_path / 'there.db'}"


UMLAUT = """
import os, sys
from torchmbd.process import file_of
from torchmbd.study.file.model import find_function
from torchmbd.tracking import MlflowTracker
assert sys.getfilesystemencoding() == "ascii", sys.getfilesystemencoding()
folder, name = os.getcwdb(), "gr\\u00f6\\u00dfe"
file = os.fsdecode(name.encode()) + ".py"
open(file, "w").write("def f(): pass")
assert find_function(f"{name}.py:f", file_of("."))
tracker = MlflowTracker("e", f"sqlite:///{sys.argv[1]}")
tracker.begin("study", os.fsdecode(name.encode()), tags={"file": file}, params={"file": file})
tracker.artifact("study", file)
tracker.end("study", "FINISHED")
print(tracker.close().runs["study"])
"""


@pytest.mark.thorough
def test_names_beyond_the_locale(tmp_path, monkeypatch):
    """A model and a study with umlauts where the locale is POSIX, in ASCII; a new store in such a folder is refused."""
    environment = {**os.environ, "LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    environment |= {"PYTHONPATH": str(Path(__file__).parents[2]), "TORCHMBD_PATIENCE": "0"}
    command = [sys.executable, "-c", UMLAUT, "runs.db"]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    monkeypatch.chdir(tmp_path)
    run = open_store("sqlite:///runs.db").get_run(result.stdout.strip())
    assert run.info.run_name == "größe"
    assert run.data.tags["file"] == run.data.params["file"] == run.data.tags["files"] == "größe.py"
    assert (tmp_path / "mlartifacts" / run.info.run_id / "artifacts/größe.py").is_file()
    (tmp_path / "ü").mkdir()
    for cwd, name in ((tmp_path / "ü", "runs.db"), (tmp_path, "ü/runs.db")):
        command[-1] = name
        refused = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
        assert "cannot be written in the encoding of this locale, ascii. Try: PYTHONUTF8=1" in refused.stderr
