"""A folder of studies that was copied elsewhere is whole; one that lacks files says which."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from torchmbd import cli


@pytest.fixture
def copied(finished, tmp_path, monkeypatch):
    """The only copy of a folder in which a study has run twice."""
    hidden = finished.folder.with_name("hidden")
    shutil.copytree(finished.folder, tmp_path / "copy")
    finished.folder.rename(hidden)
    monkeypatch.chdir(tmp_path / "copy")
    (tmp_path / "copy" / "runs.db").rename("mlflow.db")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    yield tmp_path / "copy"
    hidden.rename(finished.folder)


@pytest.mark.thorough
def test_all_commands_that_look_at_studies_work_in_a_copy(copied, finished, capsys):
    first, second = (run[:8] for run in finished.runs)
    assert cli.main(["list", "."]) == 0
    assert first in (output := capsys.readouterr().out)
    assert second in output
    assert cli.main(["best", first]) == 0
    assert first in capsys.readouterr().out
    assert cli.main(["compare", first, second]) == 0
    assert "simulate.steps" in capsys.readouterr().out
    assert cli.main(["report", first]) == 0
    page = (copied / f"short_{first}.html").read_text()
    assert page.count("data:image/png") == 5
    assert "iframe" in page


def test_what_is_stored_holds_no_absolute_path(copied, finished):
    for stored in (copied / "mlflow.db", *(copied / "mlartifacts").rglob("*.yaml")):
        content = stored.read_bytes()
        for folder in (finished.folder, Path.cwd(), Path(__file__).parents[3], Path.home()):
            assert str(folder).encode() not in content, stored


@pytest.mark.parametrize("name", ["config.yaml", "motion_best.html", "figures/convergence.png", ""])
def test_a_report_that_lacks_files_names_them_and_writes_none(copied, finished, capsys, name):
    filed = copied / "mlartifacts" / finished.runs[0] / "artifacts"
    if name:
        (filed / name).unlink()
    else:
        shutil.rmtree(copied / "mlartifacts")
    assert cli.main(["report", finished.runs[0], "--output", "r.html"]) == 2
    assert f"lacks {name}" in (text := capsys.readouterr().err)
    assert "must be a store with the whole of its folder mlartifacts" in text
    assert not (copied / "r.html").exists()
