"""Studies that do not reach their store, or are killed, and `torchmbd sync` afterwards."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

import torchmbd as mbd
from torchmbd import cli
from torchmbd.tracking.store import open_store

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture
def file(write, folder, empty_store, monkeypatch):
    """A short study in a place of its own; its store is in `store/`."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("TORCHMBD_STORE")
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0")
    (folder / "store").mkdir()
    uri = f"sqlite:///{shutil.copy(empty_store, folder / 'store')}"
    return write(simulate={"duration": 0.002, "steps": 8}, tracking={"experiment": "late", "uri": uri})


def hide(folder: Path) -> None:
    (folder / "store").rename(folder / "hidden")
    (folder / "store").write_text("")


def show(folder: Path) -> None:
    (folder / "store").unlink()
    (folder / "hidden").rename(folder / "store")


def runs(folder: Path) -> list:
    client = open_store(f"sqlite:///{folder / 'store' / 'runs.db'}")
    return client.search_runs([client.get_experiment_by_name("late").experiment_id])


def logged(folder: Path) -> dict[str, tuple]:
    """What the store says of every run: params, metrics, status, words, files."""
    result = {}
    for run in runs(folder):
        root = folder / "store" / "mlartifacts" / run.info.run_id / "artifacts"
        files = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
        words = {key: run.data.tags.get(key) for key in ("kind", "status", "message", "best", "best_start", "seed")}
        result[run.info.run_name] = run.data.params, run.data.metrics, run.info.status, words, files
    return result


@pytest.mark.thorough
def test_sync_sends_what_the_study_would_have_sent(file, folder, capsys):
    hide(folder)
    assert cli.main(["run", str(file)]) == 1
    output = capsys.readouterr().out
    assert "runs.db" in output
    assert "torchmbd sync" in output
    assert cli.main(["sync"]) == 1  # it is still away
    assert "store/runs.db' cannot be opened" in capsys.readouterr().out.replace("\n", "")
    show(folder)
    assert cli.main(["sync"]) == 0
    assert "everything is in its tracking store" in capsys.readouterr().out
    late = logged(folder)
    assert len(late) == 3
    client = open_store(f"sqlite:///{folder / 'store' / 'runs.db'}")
    for run in runs(folder):
        client.delete_run(run.info.run_id)
    assert cli.main(["run", str(file)]) in (0, cli.EXIT_UNVERIFIED)  # its runs are gone: it makes others
    assert logged(folder) == late


@pytest.mark.thorough
def test_a_finished_study_makes_no_second_run(file, folder, capsys):
    assert cli.main(["run", str(file)]) in (0, cli.EXIT_UNVERIFIED)
    first = {run.info.run_id: run.info.end_time for run in runs(folder)}
    capsys.readouterr()
    assert cli.main(["run", str(file)]) in (0, cli.EXIT_UNVERIFIED)
    output = capsys.readouterr().out
    assert "finished on" in output
    assert "nothing is run again" in output
    assert "--fresh" in output
    parent = next(run.info.run_id for run in runs(folder) if "mlflow.parentRunId" not in run.data.tags)
    assert f"runs/{parent}/artifacts" in output
    assert {run.info.run_id: run.info.end_time for run in runs(folder)} == first
    # In Python the results are there, in the same runs.
    study = mbd.Study.from_file(file).run(console=Console(quiet=True))
    assert study.best is not None
    assert {run.info.run_id for run in runs(folder)} == set(first)
    assert cli.main(["run", str(file), "--fresh"]) in (0, cli.EXIT_UNVERIFIED)
    assert len(runs(folder)) == 2 * len(first)


@pytest.mark.thorough
@pytest.mark.parametrize("change", ["file", "model", "folder"])
def test_what_is_sent_is_what_was_run(file, folder, change, monkeypatch):
    """Files that have changed since, or are elsewhere: no model is executed, and the finished study is not run again."""
    hide(folder)
    assert cli.main(["run", str(file)]) == 1
    show(folder)
    if change == "file":
        file.write_text(file.read_text().replace("seed: 7", "seed: 8"))
    elif change == "model":
        (folder / "rod_model.py").unlink()
    else:
        moved = folder.with_name("moved")
        folder.rename(moved)
        folder = moved
        monkeypatch.chdir(folder)
    assert cli.main(["sync"]) == 0
    late = logged(folder)
    assert len(late) == 3
    assert {status for _, _, status, _, _ in late.values()} == {"FINISHED"}
    parent = late["study"]
    assert parent[0]["starts.seed"] == "7"
    assert {"design.yaml", "answer.json", "figures/convergence.png", "motion_best.html"} <= parent[-1]
    [state] = (folder / ".torchmbd").glob("*/study.json")
    assert sorted(path.name for path in state.parent.iterdir()) == ["study.json", "study.lock"]
    assert cli.main(["sync"]) == 0
    assert logged(folder) == late


KILLED = """
import os, signal, sys
from torchmbd.design import Problem
from torchmbd.cli import main
evaluate, batches = Problem.evaluate, []
def deadly(self, X, gradients):
    batches.append(len(X))
    if len(batches) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return evaluate(self, X, gradients)
Problem.evaluate = deadly
main(["run", sys.argv[1]])
"""


@pytest.mark.thorough
def test_a_killed_study_is_sent_as_far_as_it_went(file, folder, capsys):
    """Then the same command goes on with it, in the same runs."""
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(file)], env=environment, capture_output=True, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    [journal] = (folder / ".torchmbd").glob("*/journal.jsonl")
    lines = journal.read_bytes()
    journal.write_bytes(b"\0" * len(lines) + b"\n")  # as a power cut may leave it
    assert cli.main(["sync"]) == 1
    assert "cannot be read" in capsys.readouterr().out.replace("\n", "")
    journal.write_bytes(lines + b'{"run": "st')  # killed within a line
    assert cli.main(["sync"]) == 0
    first = {run.info.run_id: run.info.status for run in runs(folder)}
    assert list(first.values()) == ["KILLED"] * 3
    (parent,) = [run for run in runs(folder) if "mlflow.parentRunId" not in run.data.tags]
    assert parent.data.metrics["search/evaluations"] == 4  # two batches of two starts
    assert cli.main(["run", str(file)]) in (0, cli.EXIT_UNVERIFIED)
    assert {run.info.run_id: run.info.status for run in runs(folder)} == dict.fromkeys(first, "FINISHED")
    assert "4 of " in capsys.readouterr().out
