"""A study whose problem chooses its steps: the start and the best design of its numbers are by the steps of the result."""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
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
    tags = find(tracker.uri, tracker.record.runs["study"]).tags
    assert tags["accuracy"] == best.problem.accuracy
    assert "1 of 1 start converged; better than the start (objective 2)" in tags["search"]
    assert "lower bound of bob.mass" in tags["active"]
    assert "active: lower bound of bob.mass" in output.getvalue()
    assert "none failed" in output.getvalue()


@pytest.mark.thorough
def test_a_study_tells_loads_in_its_answer_alone(recwarn: Any, tmp_path: Path, empty_store: Path) -> None:
    """A cantilever of Euler's load 74 N is pressed by 30 N; its peaks of two measures rest on one assumption."""
    stiffness = torch.diag(torch.tensor([2e5, 1e5, 1e5, 20.0, 30.0, 40.0], dtype=torch.float64))
    section = mbd.GivenSection(stiffness, torch.diag(torch.tensor([2.0, 2, 2, 3e-3, 1e-3, 2e-3])))
    column = mbd.FlexibleBody.beam("column", mbd.BeamLine.straight(1.0, 4), section, modes=4, reference="start")
    weight = mbd.RigidBody("weight", mbd.variable(1.0), (1e-3, 1e-3, 1e-3), position=(1.0, 0.0, 0.0))
    joints = [
        mbd.Fixed(mbd.Ground().at(), column.at("start"), name="foot"),
        mbd.Fixed(column.at("end"), weight.at(), name="head"),
    ]
    push = mbd.Force(column.at("end"), (-30.0, 0.0, 0.0))
    system = mbd.System([column, weight], joints, [push], truncation=None)
    sway = (mbd.Max(mbd.StrainEnergy("column")), mbd.Max(abs(mbd.Displacement("column", "x", node="end"))))
    problem = mbd.Problem(
        system, 0.1, sway[0], [sway[1] <= 1.0], steps=40, bounds={"weight.mass": (0.5, 2.0)}, backend="eager"
    )
    study = StudySettings(problem, method="slsqp", max_iterations=1, name="column")
    tracker = MlflowTracker("column", f"sqlite:///{shutil.copy(empty_store, tmp_path)}")
    run_study(study, Console(file=io.StringIO()), tracker)
    assert study.outcome is not None
    assert study.outcome.verification is not None
    peaks, loads = study.outcome.verification.notes
    assert peaks.count("assumes") == 1
    assert "column" in peaks
    assert "stiffening=True" in loads
    assert not [x for x in recwarn if "of its stiffness" in str(x.message)]
