"""Figures as an experiment: pictures, numbers and the sentence are in the store."""

from __future__ import annotations

import io
import shutil
import tempfile
from pathlib import Path

import pytest
from rich.console import Console

from torchmbd.errors import MbdError
from torchmbd.study.figures import FiguresPlan, run_figures
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load, load_study
from torchmbd.study.record.unfinished import claim_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

DRAW = """
from pathlib import Path

def figures(folder: Path, angle: float = 1.0) -> dict[str, float | str]:
    (folder / "one.pdf").write_bytes(b"%PDF")
    (folder / "notes.txt").write_text("scratch")
    return {"angle": angle, "nothing": float("nan"), "sentence": f"It turns by {angle:g}.", "word": "tag"}

def broken(folder) -> dict:
    raise ZeroDivisionError("half a picture")

def silent(folder):
    pass
"""


@pytest.fixture
def write(tmp_path):
    (tmp_path / "figures.py").write_text(DRAW)

    def write(text: str) -> Path:
        file = tmp_path / "pictures.yaml"
        file.write_text(text)
        return file

    return write


def run(file: Path, tracker) -> tuple[int, str]:
    (_, plan), output = load(file), io.StringIO()
    assert isinstance(plan, FiguresPlan)
    return run_figures(plan, Console(file=output, width=100), tracker), output.getvalue()


@pytest.mark.thorough
def test_pictures_numbers_and_the_sentence_are_in_the_store(write, tmp_path, empty_store):
    tracker = MlflowTracker("draw", f"sqlite:///{shutil.copy(empty_store, tmp_path)}")
    code, output = run(write("figures: figures.py:figures\noptions: {angle: 2.5}\n"), tracker)
    assert code == 0
    assert "It turns by 2.5." in output
    (run_,) = open_store(tracker.uri).search_runs([tracker.record.experiment_id])
    assert run_.info.status == "FINISHED"
    assert run_.data.metrics == {"angle": 2.5}
    assert run_.data.params["options.angle"] == "2.5"
    assert run_.data.tags["mlflow.note.content"] == "It turns by 2.5."
    assert (run_.data.tags["word"], run_.data.tags["kind"]) == ("tag", "figures")
    root = tmp_path / "mlartifacts" / run_.info.run_id / "artifacts"
    files = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
    assert files == {"config.yaml", "config_as_given.yaml", "figures/one.pdf"}


def test_a_function_that_fails_leaves_a_failed_run(write, tmp_path, empty_store):
    tracker = MlflowTracker("draw", f"sqlite:///{shutil.copy(empty_store, tmp_path)}")
    with pytest.raises(MbdError, match="ZeroDivisionError: half a picture"):
        run(write("figures: figures.py:broken\n"), tracker)
    assert [r.info.status for r in open_store(tracker.uri).search_runs([tracker.record.experiment_id])] == ["FAILED"]


@pytest.mark.thorough
def test_figures_leave_nothing_behind_and_go_on_after_a_death(write, tmp_path, empty_store, monkeypatch):
    uri = f"sqlite:///{shutil.copy(empty_store, tmp_path)}"
    for name, value in (("TORCHMBD_STORE", tmp_path / "place"), ("MLFLOW_TRACKING_URI", uri), ("TMPDIR", tmp_path)):
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    file = write("figures: figures.py:figures\ntracking: {experiment: drawn}\n")
    _, plan = load(file)
    assert isinstance(plan, FiguresPlan)
    with claim_study(plan, uri) as dead:  # logged, and the power went off
        tracker = MlflowTracker("drawn", uri, dead.id)
        tracker.begin("study", "pictures")
        tracker.close()
    client = open_store(uri)
    experiment = client.get_experiment_by_name("drawn")
    assert experiment is not None
    (left,) = client.search_runs([experiment.experiment_id])
    assert left.info.status == "KILLED"
    before = set(tmp_path.iterdir()) | {tmp_path / "mlartifacts"}
    assert run(file, None)[0] == 0
    (gone_on,) = client.search_runs([experiment.experiment_id])
    assert (gone_on.info.run_id, gone_on.info.status) == (left.info.run_id, "FINISHED")
    assert set(tmp_path.iterdir()) == before
    assert not list((tmp_path / "place").iterdir())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("figures: figures.py:figurs", "Try: 'figures'"),
        (
            "figures: figures.py:silent",
            "says nothing about what it returns: must be annotated with -> dict",
        ),
        (
            "figures: figures.py:figures\noptions: {angel: 1}",
            "options.angel = 1 is not an option: must be one of folder, angle",
        ),
        ("figures: figures.py:figures\noptions: {folder: /}", "options.folder is given by torchmbd"),
        (
            "figures: figures.py:figures\nminimize: {}",
            "minimize = {} is an unknown key: must be one of figures, options, tracking",
        ),
        ("figures: 3", "figures = 3"),
    ],
)
def test_faults_are_named(write, text, message):
    with pytest.raises(StudyError) as caught:
        load(write(text))
    assert message in str(caught.value)


def test_figures_are_no_study(write):
    with pytest.raises(StudyError, match="draws figures"):
        load_study(write("figures: figures.py:figures"))
