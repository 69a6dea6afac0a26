"""A study whose best design is verified, and one whose gain is an artifact of its steps: terminal, exit code, store, report."""

from __future__ import annotations

import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from torchmbd.cli import EXIT_UNVERIFIED, main
from torchmbd.study.file.load import load_study
from torchmbd.study.report.compare import print_best, print_comparison
from torchmbd.study.report.html import write_report
from torchmbd.study.report.listing import print_studies
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.catalog import find
from torchmbd.tracking.mlflow_tracker import MlflowTracker

MODEL = '''"""A mass of 1 kg on a spring, pushed at the start."""
import math

import torchmbd as mbd


def build() -> mbd.System:
    ground, stiffness = mbd.Ground(), (2.0 * math.pi * 40.0) ** 2
    bob = mbd.RigidBody("bob", mbd.variable(1.0), (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    spring = mbd.SpringDamper(ground.at(-1.0, 0.0, 0.0), bob.at(), stiffness=stiffness, rest=1.0)
    return mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])
'''
STUDY = """# Which mass vibrates least?
model: vibration.py:build
design:
  bob.mass: {{start: 1.0, lower: 0.8, upper: 1.25, unit: kg}}
simulate: {{duration: 0.1, steps: {steps}}}
minimize: {objective}
subject_to:
  - {{mass: bob, at_most: 1.2}}
optimizer: {{name: lbfgs, max_iterations: 3}}
tracking: {{experiment: vibration}}
"""
RESOLVED = "{integral: {squared: {position: {body: bob, axis: x}}}}"
ARTIFACT = "{final: {squared: {position: {body: bob, axis: x}}}}"


pytestmark = [pytest.mark.usefixtures("compiled"), pytest.mark.thorough]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: Any, empty_store: Path, native: None) -> SimpleNamespace:
    import shutil

    folder = tmp_path_factory.mktemp("verified")
    (folder / "vibration.py").write_text(MODEL)
    uri, result = f"sqlite:///{shutil.copy(empty_store, folder)}", {}
    patch = pytest.MonkeyPatch()
    patch.setenv("TORCHMBD_COMPILE", "1")
    for name, steps, objective in (("fine", 80, RESOLVED), ("coarse", 24, ARTIFACT)):
        file = folder / f"{name}.yaml"
        file.write_text(STUDY.format(steps=steps, objective=objective))
        output, tracker = io.StringIO(), MlflowTracker("vibration", uri)
        study = load_study(file)
        code = run_study(study, Console(file=output, width=100), tracker)
        run = tracker.record.runs["study"]
        result[name] = SimpleNamespace(code=code, output=output.getvalue(), study=study, run=run, file=file)
    patch.undo()
    return SimpleNamespace(uri=uri, folder=folder, **result)


def test_exit_codes_and_status(runs: SimpleNamespace) -> None:
    assert (runs.fine.code, runs.coarse.code) == (0, UNVERIFIED)
    assert UNVERIFIED == EXIT_UNVERIFIED == 3
    assert runs.fine.study.outcome.verification.verified
    assert runs.coarse.study.outcome.status == "FINISHED"
    assert not runs.coarse.study.outcome.verification.verified


def test_the_terminal_says_it(runs: SimpleNamespace) -> None:
    assert "verified: the objective changed by -" in runs.fine.output
    assert "not verified: " in runs.coarse.output
    assert "Try: steps: " in runs.coarse.output
    rows = [line for line in runs.fine.output.splitlines() if line.strip().startswith(("minimize", "at most"))]
    assert len(rows) == 2
    assert "mass of bob" in rows[1]


def test_the_store_has_it(runs: SimpleNamespace) -> None:
    entry = find(runs.uri, runs.fine.run)
    assert entry.tags["verification"].startswith("verified")
    assert entry.metrics["best/mass of bob_kg"] == pytest.approx(entry.metrics["design/mass_kg"])
    assert entry.metrics["error/mass of bob_kg"] == 0.0
    assert entry.metrics["margin/mass of bob_kg"] == pytest.approx(1.0 - entry.metrics["design/mass_kg"] / 1.2)
    assert find(runs.uri, runs.coarse.run).tags["verification"].startswith("not verified: ")
    answer = json.loads((runs.folder / "mlartifacts" / runs.fine.run / "artifacts" / "answer.json").read_text())
    assert answer["answers"][0]["goal"] == "minimize"


def test_best_compare_and_report_show_it(runs: SimpleNamespace) -> None:
    texts = []
    for function, arguments in (
        (print_best, (runs.coarse.run, runs.uri, 1)),
        (print_comparison, (runs.fine.run, runs.coarse.run, runs.uri)),
    ):
        output = io.StringIO()
        function(*arguments, Console(file=output, width=200))
        texts.append(output.getvalue())
    assert "not verified: " in texts[0]
    assert "minimize" in texts[0]
    assert "margin" in texts[0]
    assert "at most mass of bob [kg]" in texts[1]
    [line] = [line for line in texts[1].splitlines() if line.strip().startswith("verification")]
    assert "verified: the objective" in line
    page = write_report(runs.coarse.run, runs.folder / "r.html", runs.uri).read_text()
    assert '<p class="warning">not verified: ' in page
    assert "mass of bob [kg]" in page
    assert page.index("Answer") < page.index("Figures")


def test_the_list_of_studies_shows_it(runs: SimpleNamespace) -> None:
    output = io.StringIO()
    print_studies(runs.uri, Console(file=output, width=200))
    lines = {
        name: line for line in output.getvalue().splitlines() for name in ("fine", "coarse") if f" {name} " in line
    }
    assert "not verified" in lines["coarse"]
    assert "finished" in lines["fine"]


def test_the_command_tells_a_finished_study_by_its_exit_code(
    runs: SimpleNamespace, monkeypatch: Any, capfd: Any
) -> None:
    monkeypatch.chdir(runs.folder)
    for _ in range(2):  # the second time nothing is run
        assert main(["run", str(runs.coarse.file)]) == EXIT_UNVERIFIED
        assert "not verified: " in capfd.readouterr().out


def test_check_tells_the_errors_of_the_start(runs: SimpleNamespace, monkeypatch: Any, capfd: Any) -> None:
    monkeypatch.chdir(runs.folder)
    assert main(["check", str(runs.fine.file)]) == 0
    text = capfd.readouterr().out
    assert "steps: 80, as given; the largest error at the start design is" in text
    assert "evaluating the start design" in text
    assert main(["check", str(runs.coarse.file)]) in (0, EXIT_UNVERIFIED)
    assert "warning: steps: 24, as given, " in capfd.readouterr().out
