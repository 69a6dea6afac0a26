"""A study whose problem chooses its steps: the start and the best design of its numbers are by the steps of the result."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from torchmbd.study.run import run_study
from torchmbd.study.settings import StudySettings
from torchmbd.tracking.catalog import find
from torchmbd.tracking.mlflow_tracker import MlflowTracker

pytestmark = [pytest.mark.usefixtures("compiled"), pytest.mark.thorough]


def vibration() -> mbd.Problem:
    """A mass on a spring, pushed at the start: its displacement grows where the spring gets soft, its speed is limited."""
    ground, bob = mbd.Ground(), mbd.RigidBody("bob", mbd.variable(2.0), (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    spring = mbd.SpringDamper(ground.at(-1.0, 0.0, 0.0), bob.at(), stiffness=4.0e3, rest=1.0)
    system = mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])
    limits = [mbd.RMS(mbd.Displacement("bob", "x")) >= 0.0]
    options = {"bounds": (0.5, 2.0), "tolerance": 1e-4}
    return mbd.Problem(system, 1.0, mbd.Mass("bob"), limits, variables=["bob.mass"], **options)


def test_numbers_of_a_study_are_of_one_model(tmp_path: Path, empty_store: Path) -> None:
    problem = vibration()
    study = StudySettings(problem, method="slsqp", max_iterations=8, name="finer")
    output, tracker = io.StringIO(), MlflowTracker("finer", f"sqlite:///{shutil.copy(empty_store, tmp_path)}")
    code = run_study(study, Console(file=output, width=120), tracker)
    assert study.outcome is not None
    best = study.outcome.result.best
    assert best.x[0] == pytest.approx(0.5)
    assert best.problem.steps > problem.steps  # a light mass vibrates faster
    assert best.problem.problem.refined(best.x) is None
    alone = mbd.optimize(problem, "slsqp", max_iterations=8)
    assert alone.problem.steps == best.problem.steps
    np.testing.assert_allclose(best.x, alone.x, rtol=1e-9)
    assert best.history[0].accuracy == best.problem.accuracy == f"{best.problem.steps} steps"
    assert code == 0, output.getvalue()
    tags = find(tracker.record.uri, tracker.record.runs["study"]).tags
    assert tags["accuracy"] == best.problem.accuracy
    assert "1 of 1 starts converged; better than the start, 2" in tags["search"]
    assert "lower bound of bob.mass" in tags["active"]
    assert "active: lower bound of bob.mass" in output.getvalue()
    assert "none failed" in output.getvalue()
