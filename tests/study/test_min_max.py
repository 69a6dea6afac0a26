"""Objectives of several rows in experiment files: the extra variable of (18)-(20) in columns, starts, runs, what is loaded."""

from __future__ import annotations

import io
import shutil

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load_study
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.catalog import find
from torchmbd.tracking.mlflow_tracker import MlflowTracker

pytestmark = pytest.mark.usefixtures("compiled")

PEAKS = {"at_peaks": {"strain_energy": "rod"}, "count": 3}
SHORT = ["simulate.duration=0.002", "simulate.steps=20"]


def test_the_extra_variable_is_no_column(write):
    plan = load_study(write(minimize=PEAKS, starts={"sampler": "given", "points": [[20.0, -70.0]]}))
    assert plan.columns.names == ("angle_1_deg", "angle_2_deg")
    assert plan.columns.sentence(np.radians([45.0, -45.0, 1.0])) == "45, -45 deg"
    assert plan.columns.sentence(np.radians([0.0005, -12.345, 1.0])) == "0, -12.35 deg"
    problem = plan.simulated
    assert problem.names[-1] == "bound"
    np.testing.assert_allclose(problem.upper, np.append(np.radians([90.0, 90.0]), 1.0))
    points = plan.points
    np.testing.assert_allclose(points, [[*np.radians([45.0, -45.0]), 1.0], [*np.radians([20.0, -70.0]), 1.0]])


@pytest.mark.thorough
def test_a_study_of_the_highest_peaks_is_run_and_loaded(write, folder, empty_store):
    uri = f"sqlite:///{shutil.copy(empty_store, folder)}"
    plan = load_study(write(minimize=PEAKS), SHORT)
    tracker = MlflowTracker("min-max", uri)
    assert run_study(plan, Console(file=io.StringIO()), tracker) in (0, UNVERIFIED)
    study = mbd.load(tracker.record.runs["study"], uri, folder / "rod_model.py")
    metrics = find(uri, tracker.record.runs["study"]).metrics
    assert study.x.shape == (2,)
    highest = float(mbd.Max(mbd.StrainEnergy("rod")).value(study.motion)[0])
    assert [name for name in metrics if name.startswith("design/")] == ["design/angle_1_deg", "design/angle_2_deg"]
    assert highest <= metrics["objective"] * (1.0 + 2e-6)  # the peaks are below the bound


def test_a_sweep_takes_one_number(write):
    sweep = {"rod.laminate.angles[0]": {"from": -10.0, "to": 10.0, "count": 3}}
    file = write(minimize=PEAKS, sweep=sweep, optimizer=None, starts=None)
    with pytest.raises(StudyError) as caught:
        load_study(file)
    assert [fault.path for fault in caught.value.faults] == [("minimize",)]
