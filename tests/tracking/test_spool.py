"""The journal on disk: a store that is away is caught up with, dead writers are replaced, dead studies gone on with."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import threading
import time
from pathlib import Path

import pytest

from torchmbd.tracking import ProcessTracker, TrackingError, mlflow_tracker
from torchmbd.tracking.spool import Journal, Sent, clear, last_session, load_sent, locked, read_lines, save_sent
from torchmbd.tracking.store import open_store
from torchmbd.tracking.writer import Writer, deliver


@pytest.fixture(autouse=True)
def runs_db(empty_store, tmp_path):
    (tmp_path / "store").mkdir()
    shutil.copy(empty_store, tmp_path / "store")


def hide(tmp_path: Path) -> None:
    """Put a file where the store's folder should be: it cannot be opened until it is shown again."""
    (tmp_path / "store").rename(tmp_path / "hidden")
    (tmp_path / "store").write_text("")


def show(tmp_path: Path) -> None:
    (tmp_path / "store").unlink()
    (tmp_path / "hidden").rename(tmp_path / "store")


def written(tmp_path: Path) -> list:
    """All runs of the store below tmp_path/store."""
    client = open_store(f"sqlite:///{tmp_path}/store/runs.db")
    return client.search_runs([e.experiment_id for e in client.search_experiments()])


def told(folder: Path, tmp_path: Path, steps: int, status: str | None = None, key: str = "k") -> Path:
    """A session of a study as its process leaves it."""
    journal = Journal(folder, ["session", "spooled", f"sqlite:///{tmp_path}/store/runs.db", key])
    journal.append(["begin", "study", "s", None, {"a": "1"}, {}])
    journal.append(["begin", "start_0", "start 0", "study", {}, {}])
    for step in range(steps):
        journal.append(["metrics", "start_0", {"objective": 1.0 / (step + 1)}, step])
    for run in ("start_0", "study") if status else ():
        journal.append(["end", run, status])
    journal.close()
    return journal.file


def test_lines_are_read_whole_and_from_an_offset(tmp_path):
    journal = Journal(tmp_path, ["head"])
    journal.append(["a", 1])
    with journal.file.open("a") as file:
        file.write('["torn')
    lines = read_lines(journal.file, 0)
    assert [line.line for line in lines] == [["head"], ["a", 1]]
    assert read_lines(journal.file, lines[0].end) == lines[1:]
    with journal.file.open("ab") as file:
        file.write(b"\0" * 40 + b"\n")  # as a file system leaves what it had no time to write
    assert read_lines(journal.file, 0) == lines


def test_a_full_disk_holds_lines_back_until_there_is_room(tmp_path):
    """A real limit of the kernel on the size of files stands for the disk."""
    journal = Journal(tmp_path, ["head"])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (40, limits[1]))
        journal.append(["a", "x" * 50])
        journal.append(["b"])
        assert journal.trouble
        assert journal.held == 2
        assert [line.line for line in read_lines(journal.file, 0)] == [["head"]]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    journal.append(["c"])
    assert journal.trouble is None
    assert [line.line[0] for line in read_lines(journal.file, 0)] == ["head", "a", "b", "c"]


def test_sent_survives_half_a_file(tmp_path):
    save_sent(tmp_path, Sent("1", 10, {"study": "r"}))
    assert load_sent(tmp_path).runs == {"study": "r"}
    (tmp_path / "sent.json").write_text('{"session": "1", "off')
    assert load_sent(tmp_path) == Sent()


def test_the_same_study_does_not_run_twice(tmp_path):
    with locked(tmp_path, "study.lock") as first, locked(tmp_path, "study.lock", wait=False) as second:
        assert (first, second) == (True, False)


def test_a_store_that_is_away_is_caught_up_with(tmp_path):
    hide(tmp_path)
    folder = tmp_path / "study"
    file = told(folder, tmp_path, 3, "FINISHED")
    times = {line.when for line in read_lines(file, 0)}
    reply = Writer(folder, file, lambda: True, patience=0.0).run()
    assert "cannot be opened" in reply["waiting"]
    show(tmp_path)
    time.sleep(0.02)
    assert deliver(folder) is None
    runs = written(tmp_path)
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert any(run.data.metrics == {"objective": 1.0 / 3} for run in runs)
    assert {t for run in runs for t in (run.info.start_time, run.info.end_time)} <= times  # not when it was sent
    assert [file.name for file in folder.iterdir() if file.suffix != ".lock"] == ["sent.json"]


def test_a_study_may_go_on_while_what_it_left_is_sent(tmp_path):
    hide(tmp_path)
    folder = tmp_path / "study"
    told(folder, tmp_path, 3, "FINISHED")
    sending = threading.Thread(target=deliver, args=(folder, 30.0))
    sending.start()
    while not (folder / "writer.lock").exists():
        time.sleep(0.01)
    with locked(folder, "study.lock"):  # free by now, or at once
        assert sending.is_alive()  # the store is still away
        show(tmp_path)
        sending.join()
        assert (folder / "study.lock").exists()  # nothing is cleared away under the feet of a study that lives
    assert {run.info.status for run in written(tmp_path)} == {"FINISHED"}


def test_a_study_that_goes_on_goes_on_in_its_runs(tmp_path):
    folder = tmp_path / "study"
    Writer(folder, told(folder, tmp_path, 3), lambda: True).run()
    first = {run.info.run_id: run.info.status for run in written(tmp_path)}
    assert set(first.values()) == {"KILLED"}
    assert len(first) == 2
    reply = Writer(folder, told(folder, tmp_path, 5, "FINISHED"), lambda: True).run()
    assert set(reply["runs"].values()) == set(first)
    assert {run.info.status for run in written(tmp_path)} == {"FINISHED"}
    history = open_store(reply["uri"]).get_metric_history(reply["runs"]["start_0"], "objective")
    assert sorted((point.step, point.value) for point in history) == [(k, 1.0 / (k + 1)) for k in range(5)]


def points(tmp_path: Path, run: str, key: str = "objective") -> list[tuple[int, float]]:
    client = open_store(f"sqlite:///{tmp_path}/store/runs.db")
    (id,) = [r.info.run_id for r in written(tmp_path) if r.info.run_name == run]
    return sorted((p.step, p.value) for p in client.get_metric_history(id, key))


@pytest.mark.parametrize("left", ["journal", "sent"])
def test_a_clock_that_was_set_back_loses_nothing(tmp_path, monkeypatch, left):
    """The first life was killed with a clock that was a year ahead; the second knows what is later all the same."""
    folder, clock, year = tmp_path / "k", time.time_ns, 365 * 86400 * 10**9
    monkeypatch.setattr(time, "time_ns", lambda: clock() + year)
    first = told(folder, tmp_path, 3)
    if left == "sent":  # what it told is in the store, and the journal is gone
        deliver(folder)
        assert not first.exists()
    monkeypatch.setattr(time, "time_ns", clock)
    second = told(folder, tmp_path, 9, "FINISHED")
    assert int(second.stem) > int(first.stem)
    assert last_session(folder) == second
    assert deliver(folder) is None
    assert not first.exists()
    assert {run.info.run_name: run.info.status for run in written(tmp_path)} == {"s": "FINISHED", "start 0": "FINISHED"}
    assert points(tmp_path, "start 0") == [(k, 1.0 / (k + 1)) for k in range(9)]


@pytest.mark.parametrize("lived", [1, 2])
def test_a_result_at_the_step_of_the_last_iterate_is_written_when_a_study_goes_on(tmp_path, lived):
    """The first life is killed behind its last iterate, or behind its result; each is there once in the end."""
    folder, lines = (
        tmp_path / "k",
        [({"objective": 2.0, "violation": 0.1}, 5), ({"objective": 1.5, "violation": 0.0}, 5)],
    )
    for told_lines, end in ((lines[:lived], False), (lines, True)):
        journal = Journal(folder, ["session", "spooled", f"sqlite:///{tmp_path}/store/runs.db", "k"])
        journal.append(["begin", "study", "s", None, {}, {}])
        for values, step in told_lines:
            journal.append(["metrics", "study", values, step])
        if end:
            journal.append(["end", "study", "FINISHED"])
        journal.close()
        assert deliver(folder) is None
    assert points(tmp_path, "s") == [(5, 1.5), (5, 2.0)]
    (run,) = written(tmp_path)
    assert (run.data.metrics["objective"], run.data.metrics["violation"]) == (1.5, 0.0)


def test_a_study_that_has_not_told_its_end_is_ended_and_then_another_begins(tmp_path):
    folder = tmp_path / "study"
    lives = []
    for _ in range(2):  # the first was killed with everything in the store
        lives.append(Writer(folder, told(folder, tmp_path, 3, "FINISHED"), lambda: True).run())
        assert {run.info.status for run in written(tmp_path)} == {"FINISHED"}
    assert lives[0]["runs"] == lives[1]["runs"]
    assert len(written(tmp_path)) == 2
    history = open_store(lives[0]["uri"]).get_metric_history(lives[0]["runs"]["start_0"], "objective")
    assert len(history) == 3
    clear(folder)
    third = Writer(folder, told(folder, tmp_path, 1, "FINISHED"), lambda: True).run()
    assert not set(third["runs"].values()) & set(lives[0]["runs"].values())


def test_a_study_that_is_begun_anew_leaves_the_earlier_one_alone(tmp_path):
    folder = tmp_path / "study"
    first = Writer(folder, told(folder, tmp_path, 3, "FINISHED"), lambda: True).run()
    fresh = Writer(folder, told(folder, tmp_path, 3, "FINISHED", key="fresh"), lambda: True).run()
    assert not set(fresh["runs"].values()) & set(first["runs"].values())


def test_what_the_store_refuses_is_named_and_holds_nothing_up(tmp_path):
    folder = tmp_path / "study"
    journal = Journal(folder, ["session", "refused", f"sqlite:///{tmp_path}/store/runs.db", "k"])
    journal.append(["begin", "study", "s", None, {}, {}])
    journal.append(["artifact", "study", "/does/not/exist", ""])
    journal.append(["metrics", "study", {"objective": 2.0}, 0])
    journal.append(["end", "study", "FINISHED"])
    reply = Writer(folder, journal.file, lambda: True).run()
    assert "does/not/exist" in reply["refused"][0]
    (run,) = written(tmp_path)
    assert run.data.metrics == {"objective": 2.0}
    assert run.info.status == "FINISHED"


def test_a_writer_that_is_killed_is_replaced(tmp_path):
    tracker = ProcessTracker("writers", f"sqlite:///{tmp_path}/store/runs.db", tmp_path / "study", "k")
    tracker.begin("study", "s")
    os.kill(tracker._process.pid, signal.SIGKILL)
    while tracker._process.poll() is None:
        time.sleep(0.01)
    tracker.metrics("study", {"objective": 1.0}, 0)
    tracker.end("study", "FINISHED")
    record = tracker.close()
    (run,) = written(tmp_path)
    assert run.info.run_id == record.runs["study"]
    assert run.info.status == "FINISHED"
    assert run.data.metrics == {"objective": 1.0}
    assert load_sent(tmp_path / "study").runs == record.runs
    tracker.conclude()
    assert not (tmp_path / "study").exists()


def test_making_a_store_is_nothing_to_rest_from(tmp_path, monkeypatch):
    """Half a second of work at its door: at a tenth of a core the next lines would come five seconds later."""
    opened = mlflow_tracker.open_runs

    def making(uri: str, experiment: str):
        until = time.process_time() + 0.5
        while time.process_time() < until:
            pass
        return opened(uri, experiment)

    monkeypatch.setattr(mlflow_tracker, "open_runs", making)
    folder, over = tmp_path / "study", threading.Event()
    file = told(folder, tmp_path, 1)
    writer = threading.Thread(target=Writer(folder, file, over.is_set).run)
    writer.start()
    while not load_sent(folder).offset:
        time.sleep(0.01)
    began, sent = time.monotonic(), load_sent(folder).offset
    with file.open("a") as journal:
        journal.write(json.dumps([0, ["metrics", "start_0", {"objective": 0.1}, 1]]) + "\n")
    while load_sent(folder).offset == sent:
        time.sleep(0.01)
    assert time.monotonic() - began < 4.0
    over.set()
    writer.join()


def test_what_waits_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0")
    hide(tmp_path)
    tracker = ProcessTracker("away", f"sqlite:///{tmp_path}/store/runs.db", tmp_path / "study", "k")
    tracker.begin("study", "s")
    tracker.end("study", "FINISHED")
    with pytest.raises(TrackingError, match="torchmbd sync"):
        tracker.close()
    show(tmp_path)
    assert deliver(tmp_path / "study") is None
    assert [run.info.status for run in written(tmp_path)] == ["FINISHED"]
