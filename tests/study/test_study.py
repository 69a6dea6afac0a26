"""A study made in Python: the same object as of a file, tracked, resumed, parallel, reported."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from tests.optimization.analytic import Analytic
from tests.refused import ANY, refused
from tests.study.rod_model import build
from torchmbd.optimization import Evaluation, effort
from torchmbd.study.estimate import print_estimate
from torchmbd.study.record.evaluations import Evaluations
from torchmbd.study.record.paths import evaluations_file, problem_key
from torchmbd.study.report.compare import print_best
from torchmbd.study.report.html import write_report
from torchmbd.study.report.listing import study_links
from torchmbd.tracking.catalog import children, find

pytestmark = pytest.mark.usefixtures("compiled")

ENERGY = mbd.StrainEnergy("rod")
QUIET = Console(quiet=True)


def problem(**options) -> mbd.Problem:
    given = {"minimize": mbd.Integral(ENERGY), "subject_to": mbd.Max(ENERGY) <= "initial", "bounds": mbd.deg([-90, 90])}
    return mbd.Problem(build(), 0.002, steps=8, variables=["rod.laminate.angles"], **given | options)


@pytest.fixture
def own(folder, empty_store, monkeypatch):
    """A folder with a store of studies and of runs of its own."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("TORCHMBD_STORE")
    shutil.copy(empty_store, folder / "mlflow.db")
    return folder


@pytest.fixture
def small() -> mbd.Study:
    starts = mbd.optimization.sobol(2, seed=7, include_initial=True)
    return mbd.Study(
        problem(), starts, "mmfd", name="small", max_iterations=2, question="Which angles?", experiment="py"
    )


@pytest.mark.thorough
def test_a_study_of_python_and_one_of_a_file_are_the_same(own, write, small):
    file = write(simulate={"duration": 0.002, "steps": 8})
    loaded = mbd.Study.from_file(file)
    assert isinstance(loaded, mbd.Study)
    np.testing.assert_allclose(loaded.points, small.points, rtol=1e-14)
    assert loaded.columns.names == small.columns.names == ("angle_1_deg", "angle_2_deg")
    a, b = (one.run(console=QUIET) for one in (loaded, small))
    assert a.best.value == b.best.value
    assert list(a.to_dataframe().value) == list(b.to_dataframe().value)


@pytest.mark.thorough
def test_it_is_tracked_and_reported(own, small):
    with refused("study", "small", "study.run()"):
        _ = small.best
    small.run(console=QUIET)
    assert small.status == "FINISHED"
    entry = find(f"sqlite:///{own / 'mlflow.db'}", "small")
    assert entry.run_id == small.outcome.run_id
    assert entry.metrics["best_objective"] == small.best.value
    assert len(children(f"sqlite:///{own / 'mlflow.db'}", entry)) == 2
    page = small.report("small.html").read_text()
    assert "<h1>Which angles?</h1>" in page
    assert "angle_1_deg" in page or "angle 1" in page
    assert len(small.plot().axes) == 2
    assert "best" in repr(small)
    with refused("run"):
        mbd.load("small")
    shutil.copytree(own, own / "copy", ignore=lambda folder, names: {"copy"} & {*names})
    shutil.rmtree(own / "mlartifacts")
    with refused("run", ANY, "answer.json, config.yaml", "sqlite:"):
        write_report("small", own / "empty.html", f"sqlite:///{own / 'mlflow.db'}")
    assert not (own / "empty.html").exists()
    copied = write_report("small", own / "copied.html", f"sqlite:///{own / 'copy' / 'mlflow.db'}")
    assert copied.read_text() == page


@pytest.mark.thorough
def test_designs_are_feasible_by_the_tolerance_of_the_study(own):
    """On the terminal, among the results and in the tracking store."""
    corner = Analytic("corner", [2.0, 2.0], lambda x: x[0] + x[1], lambda x: [1 - x[0] * x[1]], lower=0.1, upper=5.0)
    starts = [[2.0, 2.0], [0.1, 0.1]]
    study = mbd.Study(corner, starts, "lbfgs", "corner", feasibility=1e-2, max_iterations=20).run(console=QUIET)
    assert study.status == "FINISHED"
    assert study.best is min(study.result.results, key=lambda result: result.value)
    uri = f"sqlite:///{own / 'mlflow.db'}"
    entry = find(uri, "corner")
    found = children(uri, entry)
    assert [child.metrics["objective"] for child in found] == sorted(result.value for result in study.result.results)
    assert all(1e-6 < child.metrics["violation"] <= 1e-2 for child in found)


@pytest.mark.thorough
def test_the_best_is_feasible_or_none_also_on_steps(own):
    narrow = Analytic("narrow", [0.5], lambda x: x[0], lambda x: [x[0] - 0.6, 0.4 - x[0]], lower=0.0, upper=2.0)
    study = mbd.Study(narrow, name="narrow", increments={"x1": 1.0}, max_iterations=5).run(console=QUIET)
    assert study.result.status == "infeasible"
    assert study.result.best.violation > 0.1
    assert study.best is None
    assert "best" not in repr(study)


SCRIPT = """
import os, signal, sys
import torchmbd as mbd
from tests.study.test_study import QUIET, problem
evaluate, batches = mbd.Problem.evaluate, []
def deadly(self, X, gradients):
    batches.append(len(X))
    if len(batches) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return evaluate(self, X, gradients)
mbd.Problem.evaluate = deadly
starts = mbd.optimization.sobol(2, seed=7, include_initial=True)
study = mbd.Study(problem(), starts, "mmfd", name="small", max_iterations=2, question="Which angles?", experiment="py")
study.run(console=QUIET)
"""


@pytest.mark.thorough
def test_a_killed_study_goes_on_in_its_runs(own, small):
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    killed = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    (left,) = [path for path in (own / ".torchmbd").iterdir() if path.is_dir()]
    assert str(own) not in (left / "study.json").read_text()  # the folder can be copied
    known = Evaluations(evaluations_file(), problem_key(small.simulated)).count()
    assert known == 2
    output = io.StringIO()
    small.run(console=Console(file=output, width=120))
    assert small.status == "FINISHED"
    assert "goes on; 2 evaluations of this problem are on disk" in output.getvalue().splitlines()[0]
    assert "2 of " in output.getvalue().replace("evaluations known", "")
    assert json.loads((left / "study.json").read_text())["run_id"] == small.outcome.run_id  # it makes no second run


@pytest.mark.slow  # starts two processes
def test_workers_give_the_same(own, small):
    alone = small.run(console=QUIET).best.value
    assert small.run(workers=2, fresh=True, console=QUIET).best.value == pytest.approx(alone, rel=1e-9)


class Valley:
    """A problem without mechanics."""

    names, start, lower, upper = ["x", "y"], np.array([-1.0, 2.0]), np.full(2, -3.0), np.full(2, 3.0)

    def evaluate(self, X, gradients):
        none, slopes = np.zeros(0), np.zeros((0, 2))
        df = [np.array([-2 * (1 - x) - 2 * (y - x), 2 * (y - x)]) for x, y in X]
        return [Evaluation((1 - x) ** 2 + (y - x) ** 2, none, d, slopes) for (x, y), d in zip(X, df, strict=True)]


@pytest.mark.thorough
def test_other_problems_fronts_tolerances_and_steps(own):
    result = mbd.Study(Valley(), mbd.optimization.sobol(2, seed=1), method="slsqp", name="valley").run(console=QUIET)
    np.testing.assert_allclose(result.best.x, [1.0, 1.0], atol=1e-4)
    tradeoff = mbd.Tradeoff(
        build(),
        0.002,
        {"energy": mbd.Max(ENERGY), "torsion": -mbd.Frequency("rod", 3)},
        steps=8,
        variables=["rod.laminate.angles"],
        bounds=mbd.deg([-90, 90]),
    )
    front = mbd.Study(tradeoff, name="front", max_iterations=2, divisions=2).run(console=QUIET)
    assert front.status == "FINISHED"
    assert list(front.to_dataframe().columns)[:2] == ["energy", "torsion"]
    uri = f"sqlite:///{own / 'mlflow.db'}"
    assert len(children(uri, find(uri, "front"))) == len(front.result.points)
    assert all(column in front.report("front.html").read_text() for column in (">energy [J]<", ">torsion [Hz]<"))
    entry, text = find(uri, "front"), io.StringIO()
    print_best("front", uri, 5, Console(file=text, width=120))
    assert text.getvalue().split("status")[0].count("[J]") == 1  # the criteria stand for an objective
    assert "change" not in text.getvalue()
    assert "load(" not in text.getvalue()  # a front has no one design
    assert f"{front.result.points[0].criteria[0]:.6g}" in text.getvalue()
    assert "motion" not in study_links("", entry.experiment_id, entry.run_id, entry.kind, entry.status)
    page = io.StringIO()
    print_estimate(mbd.Study(tradeoff, max_iterations=2, divisions=2), Console(file=page, width=200))
    # Of two anchors two searches and four from their ends, each anchor once more; one point twice: 12 searches.
    least, most = effort.simulations(tradeoff, "auto", 2, {})
    assert f"{12 * least} to {12 * most} simulations, if no start ends early" in page.getvalue()
    assert front.result.analyses <= 12 * most
    assert page.getvalue().count("  minimize ") == 2
    worst = mbd.optimization.RobustProblem(problem(subject_to=()), mbd.deg(2.0), "worst")
    robust = mbd.Study(worst, mbd.optimization.sobol(2, seed=1), name="robust", max_iterations=2).run(console=QUIET)
    assert robust.columns.names == ("angle_1_deg", "angle_2_deg")
    assert robust.best is not None
    stepped = mbd.Study(problem(), name="steps", max_iterations=2, increments={"rod.laminate.angles": mbd.deg(15.0)})
    angles = np.degrees(stepped.run(console=QUIET).best.x) / 15.0
    np.testing.assert_allclose(angles, angles.round(), atol=1e-9)


@pytest.mark.thorough
def test_a_sweep_as_a_data_frame(own):
    span = {"rod.laminate.angles[1]": (float(mbd.deg(-90.0)), float(mbd.deg(90.0)), 3)}
    swept = mbd.Study(problem(), name="swept", sweep=span).run(console=QUIET)
    table = swept.to_dataframe()
    assert table["angle_2_deg"].tolist() == pytest.approx([-90.0, 0.0, 90.0])
    evaluations = problem().evaluate(np.radians([[45.0, x] for x in (-90.0, 0.0, 90.0)]), False)
    assert table["objective"].tolist() == pytest.approx([e.objective for e in evaluations], rel=1e-9)
    assert table["violation"].tolist() == pytest.approx([max(float(e.constraints.max()), 0.0) for e in evaluations])
    assert table["status"].tolist() == ["ok"] * 3
    assert swept.plot().axes[0].get_xlabel() == "angle 2 [deg]"
    assert swept.best is None


@pytest.mark.thorough
def test_scenarios_are_a_study_like_any_other(own):
    cases = [{"rod.laminate.thickness": h} for h in (1e-3, 2e-3)]
    asked = mbd.Scenarios(
        build(),
        0.002,
        mbd.Max(ENERGY),
        steps=8,
        scenarios=cases,
        variables=["rod.laminate.angles"],
        bounds=mbd.deg([-90, 90]),
    )
    result = mbd.Study(asked, mbd.optimization.sobol(2, seed=1), "mmfd", name="cases", max_iterations=2).run(
        console=QUIET
    )
    assert result.status == "FINISHED"
    assert result.columns.names == ("angle_1_deg", "angle_2_deg")
    assert result.best.value <= asked.evaluate(asked.start[None], False)[0].objective


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"method": "mmdf"}, "method"),
        ({"name": ""}, "name"),
        ({"starts": [[0.0]]}, "start"),
        ({"starts": [[0.0, 9.0]]}, "start.rod.laminate.angles[1]"),
        ({"increments": {"rod.laminate.angle": 0.1}}, "increments.rod.laminate.angle"),
        ({"units": {"rod.laminate.angles": "grad"}}, "units.rod.laminate.angles"),
        ({"sweep": {"rod.laminate.angles": (0.0, 1.0, 3)}}, "sweep.rod.laminate.angles"),
        ({"sweep": {"rod.laminate.angles[0]": (0.0, 1.0)}}, "sweep"),
        ({"sweep": {"rod.laminate.angles[0]": ("a", 1.0, 3)}}, "first value of sweep"),
        ({"sweep": "rod.laminate.angles"}, "sweep"),
        ({"increments": 5.0}, "increments"),
        ({"units": "deg"}, "units"),
        ({"max_iteration": 3}, "max_iteration"),
        ({"uri": "runs.db"}, "uri"),
    ],
)  # fmt: skip
def test_what_is_refused(small, arguments, path):
    with refused(path):
        mbd.Study(small.problem, **arguments)
