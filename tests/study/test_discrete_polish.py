"""Variables of an experiment file that take steps: the best design on them, what is kept of it, what is refused."""

from __future__ import annotations

import io
import itertools
import shutil

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load_study
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

ANGLES = {"start": [45, -45], "lower": -90, "upper": 90, "unit": "deg"}
SHORT = {"duration": 0.002, "steps": 8}


def given(step, **more):
    return {"design": {"rod.laminate.angles": {**ANGLES, "step": step}}, "simulate": SHORT, **more}


@pytest.mark.thorough
def test_the_best_design_on_the_steps(write, folder, empty_store):
    """Beside all designs that there are: 6 x 6."""
    store = shutil.copy(empty_store, folder / "mlflow.db")
    optimizer = {"name": "slsqp", "max_iterations": 20}
    sections = {"subject_to": None, "optimizer": optimizer, "starts": None, "simulate": SHORT | {"steps": 24}}
    plan, output = load_study(write(**given(30) | sections)), io.StringIO()
    tracker = MlflowTracker("steps", f"sqlite:///{store}")
    assert run_study(plan, Console(file=output, width=200), tracker) in (0, UNVERIFIED)
    problem = plan.simulated
    every = np.radians(list(itertools.product(range(-90, 90, 30), repeat=2)))
    least = min(e.objective for e in problem.evaluate(every, False))
    metrics = open_store(tracker.uri).get_run(tracker.record.runs["study"]).data.metrics
    assert metrics["objective"] == pytest.approx(least, rel=1e-9)
    [start] = problem.evaluate(problem.start[None], False)
    gain = 100.0 * (start.objective - metrics["objective"]) / abs(start.objective)
    assert metrics["reduction_percent"] == pytest.approx(gain, rel=1e-9)
    assert metrics["best_objective"] == metrics["objective"]
    assert metrics["relaxed_objective"] <= (1.0 + 1e-6) * metrics["objective"]
    angles = np.array([metrics["design/angle_1_deg"], metrics["design/angle_2_deg"]])
    np.testing.assert_allclose(angles, 30 * np.round(angles / 30), atol=1e-9)
    assert problem.evaluate(np.radians(angles)[None], False)[0].objective == pytest.approx(least, rel=1e-9)
    assert "on the steps: " in output.getvalue()
    assert "no better design among" in output.getvalue()
    kept = mbd.load(tracker.record.runs["study"], f"sqlite:///{store}", folder / "rod_model.py")
    np.testing.assert_allclose(np.degrees(kept.x), angles, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (given([15, 5, 5]), r"step.* has 3 values: must have 2"),
        (given(-5), r"step.*must not be negative"),
        (
            given(5, starts=None, optimizer=None, sweep={"rod.laminate.angles[0]": {"from": 0, "to": 1, "count": 2}}),
            "sweep and a step are both given",
        ),
    ],
)
def test_what_is_wrong_is_named(write, changes, words):
    with pytest.raises(StudyError, match=words):
        load_study(write(**changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            given(5, minimize={"at_peaks": {"strain_energy": "rod"}, "count": 2}),
            "design has a step, but .* an objective of several rows",
        ),
        (
            {"design": {"rod.laminate.angles": {**ANGLES, "lower": [31, -90], "upper": [59, 90], "step": 60}}},
            "must have a value in the bounds",
        ),
    ],
)
def test_what_has_no_design_on_the_steps_is_refused_before_anything_is_kept(write, changes, words):
    with pytest.raises(mbd.InputError, match=words):
        load_study(write(**changes))
