"""The tutorial of the robot arm: its files, the errors that it tells of, its commands on a coarse copy of its study.

Its code is run by tests/test_docs.py.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import torchmbd as mbd
from tests.page_blocks import blocks, commands
from torchmbd import cli

ROOT = Path(__file__).parents[1]
HERE = ROOT / "experiments" / "tutorial"
PAGE = ROOT / "docs" / "tutorials" / "robot_arm.md"
COARSE = ["simulate.steps=40", "starts.count=2", "optimizer.max_iterations=2", "options.elements=2"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of the user's: his two files, no store."""
    for name in ("arm.py", "overshoot.yaml"):
        shutil.copy(HERE / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / ".torchmbd"))
    yield tmp_path
    sys.modules.pop("arm", None)


def test_the_experiment_file_is_the_one_that_is_printed(folder, capsys):
    [printed] = [block.text for block in blocks(PAGE) if block.language == "yaml"]
    assert printed == (folder / "overshoot.yaml").read_text(encoding="utf-8")
    assert cli.main(["new", "draft.yaml", "--model", "arm.py:build"]) == 0
    assert "arm.section.angles" in (folder / "draft.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("layers: 2", "layers: 2, lenght: 1.0"),
        ("model: arm.py:build", "model: arm.py:other"),
        ("model: arm.py:build", "model: ../arm.py:build"),
    ],
)
def test_what_is_said_of_errors_is_what_is_seen(folder, capsys, old, new):
    """The messages of the table at the end of the page."""
    table = re.findall(r"^\| `(.*?)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    (folder / "arm.py").write_text((folder / "arm.py").read_text() + "\n\ndef other():\n    return build()\n")
    file = folder / "overshoot.yaml"
    file.write_text(file.read_text().replace(old, new))
    assert cli.main(["check", "overshoot.yaml"]) == 2
    message = capsys.readouterr().err
    assert any(all(part in message for part in row.split(" ... ")) for row in table), message


@pytest.mark.slow
def test_commands(folder, capsys):
    lines = commands(PAGE)
    assert [line[0] for line in lines] == ["check", "run", "best", "report", "ui"]
    for command in lines[:-1]:  # the last one serves until Ctrl-C: tests/study/report/test_browser.py
        assert cli.main(command + (COARSE if command[0] in ("check", "run") else [])) == 0
    assert (folder / "overshoot.html").exists()
    study = mbd.load("overshoot", model="arm.py")
    assert np.isclose(study.problem.evaluate(study.x[None], False)[0].objective, study.value, rtol=1e-6)
