"""Studies that are killed and go on: the same table, nothing computed twice, one run for each start, none RUNNING."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest
from rich.console import Console

from tests.study.silent_tracker import Silent
from torchmbd.design import Problem
from torchmbd.errors import MbdError
from torchmbd.study.file.load import load_study
from torchmbd.study.record.evaluations import Evaluations
from torchmbd.study.record.paths import evaluations_file, problem_key
from torchmbd.study.record.unfinished import claim_study
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store, store_uri


@pytest.fixture
def study(write, folder, empty_store, monkeypatch):
    """A study of its own place and store."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("TORCHMBD_STORE")
    uri = f"sqlite:///{shutil.copy(empty_store, folder)}"
    return write(simulate={"duration": 0.002, "steps": 8}, tracking={"experiment": "killed", "uri": uri})


def table(output: str) -> list[str]:
    """The lines of the final table: start, objective, ..., status."""
    return [line.split()[:9] for line in output.splitlines() if re.match(r" +\d+ +[\d.e-]+ +-?[\d.]+ %", line)]


def run(file: Path, tracker=None) -> str:
    output = io.StringIO()
    run_study(load_study(file), Console(file=output, width=120), tracker)
    return output.getvalue()


def _killed_in_batch(file: Path, number: int) -> None:
    """Run the study in a process that kills itself inside its batch `number`."""
    evaluate, batches = Problem.evaluate, []

    def deadly(self, X, gradients):
        batches.append(len(X))
        if len(batches) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return evaluate(self, X, gradients)

    Problem.evaluate = deadly
    run(file, Silent())


@pytest.mark.thorough
def test_a_killed_study_repeats_no_evaluation(study, monkeypatch):
    undisturbed = run(study, Silent())
    assert "evaluations known" not in undisturbed
    total = int(re.findall(r"(\d+) of (\d+) evaluations known", run(study, Silent()))[0][1])
    for file in Path(".torchmbd").glob("evaluations.db*"):
        file.unlink()
    fork = multiprocessing.get_context("fork")
    for number in (2, 2):  # the second life dies in its own second batch
        process = fork.Process(target=_killed_in_batch, args=(study, number))
        process.start()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    output = run(study, Silent())
    assert table(output) == table(undisturbed)
    assert table(output)
    assert re.findall(r"(\d+) of (\d+) evaluations known", output) == [("4", str(total))]


@pytest.mark.thorough
def test_fresh_forgets_nothing_of_a_study_that_is_running(study, folder):
    run(study, Silent())
    plan = load_study(study)
    count = Evaluations(evaluations_file(), problem_key(plan.simulated)).count()
    assert count > 0
    uri = store_uri(plan.uri)
    message = "the same study is running in another process"
    with (
        claim_study(plan, uri),
        pytest.raises(MbdError, match=message),
    ):
        run_study(plan, Console(file=io.StringIO()), fresh=True)
    assert Evaluations(evaluations_file(), problem_key(plan.simulated)).count() == count


@pytest.mark.thorough
def test_a_study_that_was_interrupted_goes_on_in_its_runs(study, folder):
    """The first life ends by Ctrl-C after its first batch, the second by itself."""
    uri = f"sqlite:///{folder / 'runs.db'}"
    plan = load_study(study)
    lives = []
    for interrupted in (True, False):
        tracker = MlflowTracker("killed", uri, study="k")
        if interrupted:
            tell, tracker.metrics = tracker.metrics, _interrupting(tracker.metrics)
        run_study(plan, Console(file=io.StringIO()), tracker)
        if interrupted:
            tracker.metrics = tell
        runs = open_store(uri).search_runs([tracker.record.experiment_id])
        lives.append({run.info.run_id: run.info.status for run in runs})
    assert set(lives[0].values()) == {"KILLED"}
    assert set(lives[1].values()) == {"FINISHED"}
    assert lives[0].keys() == lives[1].keys()


def _interrupting(metrics):
    def tell(run, values, step=0):
        metrics(run, values, step)
        if "search/evaluations" in values and values["search/evaluations"] > 2:
            raise KeyboardInterrupt

    return tell


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_killed_at_twenty_random_moments(write, folder, monkeypatch, workers):
    """kill -9 of the study or its workers, ten times; then the same table, one run for each start, no zombie."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("TORCHMBD_STORE", str(folder / "place"))
    uri = f"sqlite:///{folder / 'runs.db'}"
    file = write(
        starts={"sampler": "sobol", "count": 32, "seed": 7},
        optimizer={"name": "mmfd", "max_iterations": 12},
        tracking={"experiment": "killed", "uri": uri},
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    command = [sys.executable, "-u", "-m", "torchmbd.cli", "run", str(file), "--workers", str(workers)]
    chance, ended, struck = random.Random(workers), 0, []
    for life in range(10):
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        ended += _struck(process, chance, struck, "worker" if life % 2 else "")
        if process.returncode in (0, UNVERIFIED):  # it was faster: the next one has all to do again
            for left in (folder / "place").glob("evaluations.db*"):
                left.unlink()
    last = subprocess.run(command, env=environment, capture_output=True, text=True).stdout
    client = open_store(uri)
    runs = client.search_runs([client.get_experiment_by_name("killed").experiment_id], max_results=1000)
    assert {run.info.status for run in runs} == {"FINISHED"}
    above = [run.data.tags.get("mlflow.parentRunId") for run in runs]
    studies = {run.info.run_id for run, parent in zip(runs, above, strict=True) if parent is None}
    assert Counter(parent for parent in above if parent) == dict.fromkeys(studies, 32)
    assert len(studies) == ended + 1
    assert len(struck) >= 7
    assert set(struck) >= ({"study"} if workers == 1 else {"study", "worker"})
    elsewhere = environment | {"TORCHMBD_STORE": str(folder / "undisturbed")}
    undisturbed = subprocess.run(command, env=elsewhere, capture_output=True, text=True).stdout
    assert table(undisturbed) == table(last)
    assert len(table(last)) == 32


def _struck(process: subprocess.Popen, chance: random.Random, struck: list[str], role: str) -> int:
    """Kill a study or a process of its own, of that role if there is one, at a random moment.

    Returns whether the study had logged its end by then.
    """
    assert process.stdout is not None
    if chance.random() < 0.7:  # while it computes; else while it starts
        next((line for line in process.stdout if "iteration" in line), None)
    time.sleep(chance.uniform(0, 5))
    family = {process.pid: "study", **_below(process.pid)}
    target = chance.choice([pid for pid in family if family[pid] == role] or list(family))
    if process.poll() is None:
        os.kill(target, signal.SIGKILL)
        struck.append(family[target])
        if target != process.pid:
            time.sleep(1)
            process.kill()
    output, _ = process.communicate()
    return int("study: finished" in output)


def _below(study: int) -> dict[int, str]:
    """The processes that a study has started, by what they do."""
    result = {}
    with contextlib.suppress(psutil.NoSuchProcess):
        for process in psutil.Process(study).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                result[process.pid] = "store" if "tracking.writer" in " ".join(process.cmdline()) else "worker"
    return result


@pytest.mark.slow
def test_a_full_disk_is_a_message_and_no_loss(write, folder, monkeypatch):
    """No file may grow beyond 36 KiB: more than SQLite's index of a log, less than that log and MLflow's database."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("TORCHMBD_STORE")
    file = write(starts={"sampler": "sobol", "count": 12, "seed": 7}, tracking={"experiment": "full"})
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), "TORCHMBD_PATIENCE": "1"}
    command = f"trap '' XFSZ; ulimit -f {{}}; exec {sys.executable} -m torchmbd.cli run {file.name}"

    def shell(limit):
        return subprocess.run(["bash", "-c", command.format(limit)], env=environment, capture_output=True, text=True)

    full = shell(36)
    assert full.returncode == 1
    assert "Traceback" not in full.stderr
    assert "The last evaluations are not on disk" in full.stdout
    assert len(table(full.stdout)) == 12
    again = shell("unlimited")
    assert again.returncode in (0, UNVERIFIED), again.stdout + again.stderr
    assert table(again.stdout) == table(full.stdout)
    runs = open_store(f"sqlite:///{folder / 'mlflow.db'}").search_runs(["1"])
    assert {run.info.status for run in runs} == {"FINISHED"}
    assert len(runs) == 13
