"""Tolerances of an experiment file: what the optimizer sees, what is kept, what is refused, what it costs."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from tests.study.conftest import VALID
from torchmbd.optimization import effort
from torchmbd.study.estimate import estimate, print_estimate
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load_study
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

pytestmark = pytest.mark.usefixtures("compiled")

ANGLES = {"start": [45, -45], "lower": -90, "upper": 90, "unit": "deg"}
SHORT = {"duration": 0.002, "steps": 8}


def given(tolerance, **more):
    angles = ANGLES if tolerance is None else {**ANGLES, "tolerance": tolerance}
    return {"design": {"rod.laminate.angles": angles}, "simulate": SHORT, **more}


@pytest.mark.thorough
def test_the_criterion_is_the_mean_over_the_tolerances(write):
    """By sampling angles that are off."""
    plan = load_study(write(**given([3.0, 6.0], subject_to=None)))
    problem = plan.simulated
    target = plan.problem
    off = np.random.default_rng(1).uniform(-1.0, 1.0, (400, 2)) * np.radians([3.0, 6.0])
    values = np.array([e.objective for e in problem.evaluate(problem.start + off, False)])
    (result,) = target.evaluate(target.start[None], False)
    spread = values.std() / np.sqrt(len(values))
    assert result.objective == pytest.approx(values.mean(), abs=4.0 * spread)
    assert abs(result.objective - problem.evaluate(problem.start[None], False)[0].objective) > 0.2 * spread


@pytest.mark.thorough
def test_a_study_with_tolerances(write, tmp_path, empty_store):
    """Its designs are those of the same problem in Python; every simulation is kept, and known the next time."""
    plan, output = load_study(write(**given(4.0, starts=None))), io.StringIO()
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    (tmp_path / "mlflow.db").write_bytes(empty_store.read_bytes())
    tracker = MlflowTracker("tolerances", uri)
    assert run_study(plan, Console(file=output, width=200), tracker) in (0, UNVERIFIED)
    assert "mean over the tolerances" in output.getvalue()
    own = mbd.optimization.RobustProblem(plan.simulated, mbd.deg([4.0, 4.0]))
    alone = mbd.optimize(own, "mmfd", max_iterations=2)
    metrics = open_store(uri).get_run(tracker.record.runs["study"]).data.metrics
    assert metrics["objective"] == pytest.approx(alone.value, rel=1e-9)
    angles = [metrics[f"design/angle_{k}_deg"] for k in (1, 2)]
    np.testing.assert_allclose(angles, np.degrees(alone.x), atol=1e-6)
    assert metrics["search/evaluations"] >= 5 * alone.analyses
    count = f"{metrics['search/evaluations']:.0f}"
    next_command = load_study(write(**given(4.0, starts=None)))
    for after in (plan, next_command):
        again = io.StringIO()
        assert run_study(after, Console(file=again, width=200), MlflowTracker("again", uri)) in (0, UNVERIFIED)
        known = re.search(r"(\d+) of (\d+) evaluations known", again.getvalue())
        assert known is not None, again.getvalue()
        assert known[1] == known[2] == count


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (given([1.0, 2.0, 3.0]), r"tolerance.* has 3 values: must have 2"),
        (given(-1.0), r"tolerance.*must not be negative"),
        (
            given(2.0, starts=None, optimizer=None, sweep={"rod.laminate.angles[0]": {"from": 0, "to": 1, "count": 2}}),
            "sweep and a tolerance are both given",
        ),
    ],
)
def test_what_is_wrong_is_named(write, changes, words):
    with pytest.raises(StudyError, match=words):
        load_study(write(**changes))


@pytest.mark.thorough
def test_scenarios_and_tolerances_multiply():
    thick = [{"arm.laminate.thickness": [x, x]} for x in (1e-3, 2e-3, 3e-3)]
    over = mbd.Scenarios(
        mbd.examples.arm(),
        0.01,
        mbd.Integral(mbd.StrainEnergy("arm")),
        scenarios=thick,
        objective="mean",
        variables=["arm.laminate.angles"],
        steps=4,
    )
    robust = mbd.optimization.RobustProblem(over, mbd.deg(2.0))
    assert robust.simulations == 3 * 5
    study = mbd.Study(robust, max_iterations=2)
    cost, output = estimate(study, study.simulated), io.StringIO()
    counts = effort.simulations(robust, "auto", 2, {})
    assert (cost.simulations, cost.lanes) == (tuple(n * 3 * 5 for n in counts), 3 * 5)
    print_estimate(study, Console(file=output, width=200))
    assert "mean over the tolerances, mean of 3 scenarios" in output.getvalue()


def test_what_the_problem_refuses_is_refused_before_anything_is_kept(write):
    file = write(**given(2.0, subject_to=[{"frequency": {"body": "rod"}, "equal": 100.0}]))
    with pytest.raises(mbd.InputError, match="problem has equalities"):
        load_study(file)


@pytest.mark.thorough
def test_the_cost_counts_every_design_that_is_looked_at(write):
    plain, off = (load_study(write(**given(x, starts=None))) for x in (None, 2.0))
    costs = [estimate(plan, plan.simulated).simulations for plan in (plain, off)]
    assert [n / 5 for n in costs[1]] == list(costs[0])
    output = io.StringIO()
    print_estimate(off, Console(file=output, width=200))
    assert "1 constraint, mean over the tolerances" in output.getvalue()
    assert "tolerance" not in VALID
