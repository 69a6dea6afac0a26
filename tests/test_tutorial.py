"""The tutorial is run as it stands there: its code, its experiment file, its commands on a coarse copy of its study."""

from __future__ import annotations

import doctest
import re
import shutil
import sys

import numpy as np
import pytest

import torchmbd as mbd
from tests.test_guides import DOCS, code
from torchmbd import cli

HERE = DOCS / "tutorial"
PAGE = (HERE / "README.md").read_text(encoding="utf-8")
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


def test_code_and_numbers(folder):
    page = doctest.DocTestParser().get_doctest(code(HERE / "README.md"), {}, "tutorial", None, 0)
    assert len(page.examples) > 8
    report: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(page, out=report.append)
    assert not report, "".join(report)


def test_the_experiment_file_is_the_one_that_is_printed(folder, capsys):
    [printed] = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
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
    table = re.findall(r"^\| `(.*?)` \|", PAGE, re.MULTILINE)
    (folder / "arm.py").write_text((folder / "arm.py").read_text() + "\n\ndef other():\n    return build()\n")
    file = folder / "overshoot.yaml"
    file.write_text(file.read_text().replace(old, new))
    assert cli.main(["check", "overshoot.yaml"]) == 2
    message = capsys.readouterr().err
    assert any(all(part in message for part in row.split(" ... ")) for row in table), message


@pytest.mark.slow
def test_commands(folder, capsys):
    commands = [
        line.split()[1:] for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()
    ]
    assert [command[0] for command in commands] == ["check", "run", "best", "report", "ui"]
    for command in commands[:-1]:  # the last one serves until Ctrl-C: tests/study/test_browser.py
        assert cli.main(command + (COARSE if command[0] in ("check", "run") else [])) == 0
    assert (folder / "overshoot.html").exists()
    study = mbd.load("overshoot", model="arm.py")
    assert np.isclose(study.problem.evaluate(study.x[None], False)[0].objective, study.value, rtol=1e-6)
