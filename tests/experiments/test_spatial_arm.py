"""The spatial arm: a file and Python ask the same question; gradients against differences; where its drives lead."""

from __future__ import annotations

import io
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from rich.console import Console

import torchmbd as mbd
from experiments.models.spatial_arm import END, PAYLOADS, build, problem
from torchmbd.study.file.load import load_study
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

pytestmark = pytest.mark.usefixtures("compiled")

FILE = Path(__file__).parents[2] / "configs" / "spatial_arm" / "least_vibration.yaml"

SMALL = ["simulate.steps=60", "options.around=8", "scenarios=[{set: {tool.mass: 0.5}}, {set: {tool.mass: 1.1}}]"]


@pytest.fixture(scope="module")
def small() -> mbd.Scenarios:
    return problem(around=8, payloads=[0.5, 1.1], steps=60)


@pytest.mark.thorough
def test_file_and_python_ask_the_same(small):
    """Names, bounds, objective and constraints, with two of the twenty payloads; the file is short."""
    asked = mbd.problem_of(FILE, *SMALL)
    assert asked.names == small.names
    for name in ("start", "lower", "upper"):
        np.testing.assert_allclose(getattr(asked, name), getattr(small, name), rtol=1e-14)
    [one], [two] = asked.evaluate(asked.start[None], False), small.evaluate(small.start[None], False)
    assert one.objective == pytest.approx(two.objective, rel=1e-12)
    np.testing.assert_allclose(one.constraints, two.constraints, rtol=0, atol=1e-12)
    text = FILE.read_text(encoding="utf-8")
    assert [case["set"]["tool.mass"] for case in yaml.safe_load(text)["scenarios"]] == pytest.approx(PAYLOADS)
    assert len(text.splitlines()) <= 60


@pytest.mark.thorough
def test_gradients_against_differences():
    """Of objective and mass, by ply angles, wall thicknesses and the length of a link.

    With 60 steps the differences are off by 1e-5: what the iteration of a step leaves is not differentiated.
    """
    small = problem(around=8, payloads=[0.5, 1.1], steps=150)
    x = small.start + 0.02 * (small.upper - small.lower) * np.linspace(-1.0, 1.0, len(small.start))
    [exact] = small.evaluate(x[None], True)
    assert exact.status == "ok"
    assert exact.objective_gradient is not None
    for k in (1, 4, 10):
        h = 2e-4 * (small.upper - small.lower)[k] * np.eye(len(x))[k]
        result = small.evaluate(np.stack([x + h, x - h, x + 2 * h, x - 2 * h]), False)
        y = [e.objective for e in result]
        one, two = (y[0] - y[1]) / (2 * h[k]), (y[2] - y[3]) / (4 * h[k])
        scale = exact.objective / (small.upper - small.lower)[k]
        assert exact.objective_gradient[k] == pytest.approx((4 * one - two) / 3, rel=1e-6, abs=1e-6 * scale), (
            small.names[k]
        )


@pytest.mark.thorough
def test_it_starts_at_rest_and_ends_where_its_drives_lead():
    system = build(around=8)
    motion = mbd.simulate(system, END, steps=60, start="equilibrium").require_ok()
    still = mbd.equilibrium(system)
    first, last = (motion.body("tool").r[0, k] for k in (0, -1))
    torch.testing.assert_close(first, still.body("tool").r[0, 0], rtol=0, atol=1e-9)
    reach = 0.5 + 0.4 * math.cos(math.pi / 6)
    expected = torch.tensor([reach / 2, reach * math.sqrt(0.75), 0.2]).double()
    torch.testing.assert_close(last, expected, rtol=0, atol=0.02)  # it sags and vibrates


@pytest.mark.thorough
def test_its_file_runs(tmp_path, empty_store):
    """One iteration; constraints are tracked by their names."""
    plan = load_study(FILE, [*SMALL, "starts.count=1", "optimizer.max_iterations=1"])
    shutil.copy(empty_store, tmp_path / "runs.db")
    tracker = MlflowTracker("spatial_arm", f"sqlite:///{tmp_path / 'runs.db'}")
    assert run_study(plan, Console(file=io.StringIO()), tracker) in (0, UNVERIFIED)
    store = open_store(tracker.uri)
    runs = store.search_runs([tracker.record.experiment_id])
    assert {run.info.status for run in runs} == {"FINISHED"}
    [first] = [run for run in runs if run.data.tags["kind"] == "start"]
    assert first.data.metrics["search/failed_evaluations"] == 0
    asked = {"mass of upper _ mass of fore", "max of ply failure of upper", "max of ply failure of fore"}
    assert {f"constraint/{name}" for name in asked} <= set(first.data.metrics)
