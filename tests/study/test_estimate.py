"""What `torchmbd check` says a study will cost: counted, and compared with a batch that is really run."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from torchmbd.optimization import effort
from torchmbd.simulation import Simulation
from torchmbd.study.estimate import estimate, print_estimate
from torchmbd.study.file.load import load_study

simulate = Simulation.__call__

pytestmark = pytest.mark.usefixtures("compiled")


def clock_of(seconds: list[float]) -> SimpleNamespace:
    return SimpleNamespace(perf_counter=lambda: seconds[0])


@pytest.mark.thorough
def test_simulations_are_counted(write):
    plan = load_study(
        write(starts={"sampler": "sobol", "count": 70, "seed": 1}, simulate={"duration": 1e-3, "steps": 4})
    )
    cost = estimate(plan, plan.simulated)
    least, most = effort.simulations(plan.problem, "mmfd", 2, {})
    assert (cost.simulations, cost.lanes) == ((70 * least, 70 * most), 64)
    assert cost.seconds == pytest.approx([n * 2 * cost.batch_seconds + cost.once for n in (least, most)])
    assert cost.once > 0.0
    sweep = {"rod.laminate.angles[0]": {"from": 0, "to": 1, "count": 9}}
    plan = load_study(write(sweep=sweep, starts=None, optimizer=None, simulate={"duration": 1e-3, "steps": 4}))
    assert estimate(plan, plan.simulated).simulations == (10, 10)  # with the start design


@pytest.mark.thorough
@pytest.mark.parametrize(("design", "measured"), [(1.0, 4), (30.0, 2), (100.0, 1)])
def test_the_time_is_that_of_a_batch(write, monkeypatch, design, measured):
    """By a clock that only evaluations move: a batch, or as much of it as there is time for."""
    plan = load_study(write(starts={"sampler": "sobol", "count": 4, "seed": 1}))
    clock, batches = [0.0], []
    loading = [5.0]

    def evaluate(X, gradients):
        batches.append((len(X), gradients))
        clock[0] += design * len(X) + (loading.pop() if loading else 0.0)

    monkeypatch.setattr(plan.simulated, "evaluate", evaluate)
    monkeypatch.setattr("torchmbd.study.estimate.time", clock_of(clock))
    cost = estimate(plan, plan.simulated)
    one = [(1, True)] * (1 if design > 60.0 else 2)
    assert batches == one + [(measured, True)] * (measured > 1)
    assert cost.batch_seconds == pytest.approx(4 * (design + 5.0 * (design > 60.0)))
    assert cost.design_seconds == pytest.approx(cost.batch_seconds / 4)


@pytest.mark.thorough
def test_the_cost_of_a_valid_file(write):
    output = io.StringIO()
    print_estimate(load_study(write(simulate={"duration": 1e-3, "steps": 4})), Console(file=output, width=200))
    text = output.getvalue()
    assert "is valid: integral of strain energy of rod, 2 design variables, 1 constraint" in text
    assert "6 to 40 simulations, if no start ends early (limit: max_analyses), in batches of 2" in text
    assert "of them once (loading, verification, pictures, MLflow)" in text
    assert f"gradients: {load_study(write()).simulated.gradients} mode, chosen by an estimate" in text
    assert "retained modes: make joints and forces" in text  # what these leave out (diagnosis/truncation.py)


@pytest.mark.thorough
def test_scenarios_of_several_systems_count(monkeypatch):
    """By a clock that only simulations move: every batch simulates each system with a lane for each of its scenarios."""
    clock, light, heavy = [0.0], mbd.examples.arm(), mbd.examples.arm()

    def counted(simulation, designs, *others, **options):
        clock[0] += len(next(iter(designs.values())))
        return simulate(simulation, designs, *others, **options)

    payload = {"arm.laminate.thickness": [2e-3, 2e-3]}
    problem = mbd.Scenarios(
        light,
        0.02,
        mbd.Integral(mbd.StrainEnergy("arm")),
        scenarios={"light": {"arm.laminate.thickness": [1e-3, 1e-3]}, "thick": payload, "heavy": {"system": heavy}},
        objective="mean",
        variables=["arm.laminate.angles"],
        steps=20,
    )
    monkeypatch.setattr(Simulation, "__call__", counted)
    monkeypatch.setattr("torchmbd.study.estimate.time", clock_of(clock))
    points = np.tile(problem.start, (2, 1))
    study = SimpleNamespace(problem=problem, sweep=None, points=points, method="auto", max_iterations=4, options={})
    cost = estimate(study, problem)
    counts = effort.simulations(problem, "auto", 4, {})
    assert (cost.simulations, cost.lanes) == (tuple(2 * n * 3 for n in counts), 2 * 3)
    assert cost.batch_seconds == pytest.approx(6.0)
