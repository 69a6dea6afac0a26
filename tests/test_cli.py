"""The command line as a user meets it: exit codes, messages without traceback, Ctrl-C, the MLflow server."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from torchmbd import cli
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

pytestmark = pytest.mark.usefixtures("compiled")

HERE = Path(__file__).parent / "study"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with a model and a study, and no store."""
    shutil.copy(HERE / "rod_model.py", tmp_path)
    shutil.copy(HERE / "study.yaml", tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("TORCHMBD_STORE")
    monkeypatch.setenv("TORCHMBD_PATIENCE", "0.5")
    return tmp_path


def start(*arguments, **options):
    """Start the command in a process of its own, as a shell does."""
    return subprocess.Popen(
        [sys.executable, "-u", "-m", "torchmbd.cli", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])},
        **options,
    )


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["run", "missing.yaml"], ["missing.yaml: 1 error", "No such file"]),
        (["run", "study.yaml", "optimizer.nam=mmfd", "starts.seed=-1"], ["2 errors", "optimizer.nam", "starts.seed"]),
        (["run", "study.yaml", "--max-iterations", "3"], []),
        (["run"], []),
        (["runn", "study.yaml"], []),
        (["list", "--uri", "sqlite:///", "extra", "words"], []),
        (["ui", "--uri", "STORE", "--port", "70000"], ["port = 70000"]),
        (["ui"], ["mlflow.db", "does not contain a study yet"]),
        (["ui", "--uri", "runs.db"], ["uri = 'runs.db'", "sqlite:///mlflow.db"]),
        (["best", "--uri", "ftp://x/y"], ["uri = 'ftp://x/y'", "postgresql:"]),
        (["run", "study.yaml", "tracking.uri=sqlite:///a?b.db"], ["tracking.uri = 'sqlite:///a?b.db'", "without"]),
        (["best", "--count", "0"], ["count = 0", "1 or more"]),
        (["run", "study.yaml", "--workers", "-1"], ["workers = -1", "0 (one for each core) or more"]),
        (["run", "study.yaml", "--scheduler", "here"], ["scheduler = 'here'", "tcp://host:8786"]),
        (["run", "study.yaml", "simulate.duration=1e-300"], ["steps of 1.67e-302 s", "1e-12"]),
        (["check", "study.yaml", "options.cells=2,0"], ["cells = (0, 2)", ">= 1"]),
        (["run", "study.yaml", "--no-fresh"], []),
    ],
)
def test_bad_input_ends_with_2_and_no_traceback(folder, empty_store, capsys, arguments, messages):
    arguments = [word.replace("STORE", f"sqlite:///{empty_store}") for word in arguments]
    assert cli.main(arguments) == 2
    output = capsys.readouterr()
    for message in messages:
        assert message in output.err
    assert "Traceback" not in output.out + output.err
    assert output.err or output.out
    assert not (folder / "mlflow.db").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_study_that_is_interrupted_keeps_what_was_computed(folder, empty_store, number):
    shutil.copy(empty_store, folder / "mlflow.db")
    study = start("run", "study.yaml", "optimizer.max_iterations=100", "optimizer.name=mmfd", "simulate.steps=100")
    assert study.stdout is not None
    lines = iter(study.stdout.readline, "")
    shown = next(line for line in lines if re.search(r"start +1 +iteration +0", line))
    study.send_signal(number)
    output, error = study.communicate(timeout=600)
    assert "Traceback" not in error
    assert study.returncode == 130
    assert "killed" in output
    client = open_store(f"sqlite:///{folder / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("test").experiment_id])
    assert {run.info.status for run in runs} == {"KILLED"}
    assert len(runs) == 3
    (child,) = [run for run in runs if run.data.params.get("start") == "1"]
    first = client.get_metric_history(child.info.run_id, "objective")[0]
    assert f"{first.value:.6g}" in shown


@pytest.mark.parametrize(("command", "says"), [("run", "the same command goes on"), ("check", "interrupted\n")])
def test_an_interruption_outside_of_the_search_is_said(folder, monkeypatch, capsys, command, says):
    def interrupted(*given, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchmbd.study.file.load.load", interrupted)
    assert cli.main([command, "study.yaml"]) == 130
    assert says in capsys.readouterr().err


@pytest.mark.thorough
def test_a_store_that_cannot_be_written_costs_no_result(folder, capsys):
    """The study ends with its table and says that it was not recorded."""
    (folder / "file").write_text("")
    short = ["simulate.duration=0.002", "simulate.steps=8", "optimizer.max_iterations=1"]
    assert cli.main(["run", "study.yaml", f"tracking.uri=sqlite:///{folder}/file/runs.db", *short]) == 1
    shown = capsys.readouterr()
    assert "Traceback" not in shown.err
    for words in ("2 starts", "Tracking failed: the store", "torchmbd sync"):
        assert words in shown.out


@pytest.mark.thorough
def test_several_values_of_a_key_are_several_studies(folder, capsys, empty_store):
    shutil.copy(empty_store, folder / "mlflow.db")
    arguments = ["run", "study.yaml", "options.cells=3,4", "simulate.duration=0.002", "simulate.steps=8"]
    assert cli.main([*arguments, "starts.count=1", "optimizer.max_iterations=1"]) in (0, cli.EXIT_UNVERIFIED)
    assert "options.cells=3 " in (output := capsys.readouterr().out)
    assert output.count(": 1 start, ") == 2
    assert cli.main([*arguments, "starts.sampler=sobel"]) == 2  # all are checked before the first runs
    assert cli.main(["best"]) == 0
    assert ', model="rod_model.py")' in capsys.readouterr().out
    assert cli.main(["compare", "study", "nothing"]) == 2
    assert "'nothing': must be study" in capsys.readouterr().err
    assert cli.main(["report", "study", "--output", "study.html"]) == 0
    assert (folder / "study.html").exists()
    assert cli.main(["sync"]) == 0
    assert "everything is in its tracking store" in capsys.readouterr().out


@pytest.mark.thorough
def test_an_odd_folder_and_an_odd_name(folder, capsys, monkeypatch, empty_store):
    """Nothing in a name is read as markup, as a URL, or as an option."""
    odd = folder / "my [red]study# 'é'"
    odd.mkdir()
    shutil.copy(folder / "rod_model.py", odd / "my model.py")
    text = (folder / "study.yaml").read_text().replace("rod_model.py", "my model.py")
    (odd / "st[u]dy.yaml").write_text(text.replace("duration: 0.01, steps: 60", "duration: 0.002, steps: 8"))
    shutil.copy(empty_store, odd / "mlflow.db")
    monkeypatch.chdir(odd)
    assert cli.main(["run", "st[u]dy.yaml", "starts.count=1", "optimizer.max_iterations=1"]) in (0, cli.EXIT_UNVERIFIED)
    assert "st[u]dy: finished" in capsys.readouterr().out
    assert cli.main(["best", "st[u]dy"]) == 0
    assert "st[u]dy, " in capsys.readouterr().out
    assert list((odd / "mlartifacts").rglob("design.yaml"))
    (folder / "50%").mkdir()
    monkeypatch.chdir(folder / "50%")
    assert cli.main(["run", "../study.yaml"]) == 2  # MLflow would put its files elsewhere
    assert "MLflow misreads" in capsys.readouterr().err


def test_what_the_system_refuses_is_a_message(folder, capsys, monkeypatch):
    (folder / "file").write_text("")
    assert cli.main(["new", "file/study.yaml"]) == 1
    assert "file" in capsys.readouterr().err
    monkeypatch.setenv("TORCHMBD_STORE", str(folder / "file"))
    assert cli.main(["run", "study.yaml"]) == 1
    assert "evaluations.db cannot be opened" in capsys.readouterr().err
    (folder / "mlflow.db").write_text("no database at all, whatever its name says")
    assert cli.main(["best"]) == 1
    assert "not a database" in capsys.readouterr().err


@pytest.mark.thorough
def test_the_next_command_can_be_copied(folder, capsys):
    assert cli.main(["new", "my arm.yaml", "--model", "rod_model.py:build"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "next: torchmbd check 'my arm.yaml'"


@pytest.mark.thorough
def test_new_check_and_schema(folder, capsys):
    assert cli.main(["new", "mine.yaml", "--model", "rod_model.py:build"]) == 0
    assert cli.main(["check", "mine.yaml", "simulate.duration=0.002", "simulate.steps=8", "starts.count=2"]) == 0
    assert "mine.yaml is valid" in (output := capsys.readouterr().out)
    assert "90 to 256 simulations, if no start ends early" in output  # of two starts, 30 iterations
    assert not (folder / "mlflow.db").exists()
    assert cli.main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "torchmbd experiment"


@pytest.mark.thorough
def test_list_names_configs_and_studies(folder, capsys):
    assert cli.main(["list", "--folder", "."]) == 0
    output = capsys.readouterr().out
    assert "What is the best lay-up of the test rod?" in output
    assert "No studies yet" in output
    assert not (folder / "mlflow.db").exists()

    tracker = MlflowTracker("demo")
    tracker.begin("study", "rod_study", tags={"kind": "study"})
    tracker.begin("start_0", "start 0", parent="study", tags={"kind": "start"})
    tracker.metrics("study", {"best_objective": 0.125, "reduction_percent": 91.5})
    tracker.end("start_0", "FINISHED")
    tracker.end("study", "FINISHED")
    tracker.close()
    assert cli.main(["list"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "rod_study" in line]
    for cell in ("demo", "finished", "0.125", "-91.50 %"):
        assert cell in row
    assert len(row) <= 80


@pytest.mark.slow
def test_ui_serves_the_store_on_loopback_and_ends_on_sigterm(folder):
    tracker = MlflowTracker("served")
    tracker.begin("study", "rod_study", tags={"kind": "study"})
    tracker.end("study", "FINISHED")
    record = tracker.close()
    server = start("ui", "--port", "50731")
    assert server.stdout is not None
    shown = []
    for line in iter(server.stdout.readline, ""):
        shown.append(line)
        if "Ctrl-C" in line:
            break
    text = "".join(shown)
    assert f"http://127.0.0.1:50731/#/experiments/{record.experiment_id}/runs" in text
    assert record.runs["study"] in text
    page = urllib.request.urlopen("http://127.0.0.1:50731/", timeout=10).read()
    assert b"<html" in page
    server.send_signal(signal.SIGTERM)
    assert server.wait(timeout=30) == 0
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen("http://127.0.0.1:50731/", timeout=10)


@pytest.mark.thorough
def test_the_module_has_the_exit_code_of_the_command():
    for module in ("torchmbd", "torchmbd.cli"):
        done = subprocess.run([sys.executable, "-m", module, "runn"], capture_output=True)
        assert done.returncode == 2
