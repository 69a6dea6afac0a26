"""What `torchmbd check` says a study will cost: counted, and compared with a batch that is really run."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

import torchmbd as mbd
from torchmbd.integrate.phases.phase import phases_within
from torchmbd.simulation import Simulation
from torchmbd.study.estimate import estimate, print_estimate
from torchmbd.study.file.load import load_study

simulate = Simulation.__call__

pytestmark = pytest.mark.usefixtures("compiled")


def clock_of(seconds: list[float]) -> SimpleNamespace:
    return SimpleNamespace(perf_counter=lambda: seconds[0], process_time=lambda: seconds[0])


@pytest.mark.thorough
def test_simulations_are_counted(write):
    plan = load_study(
        write(starts={"sampler": "sobol", "count": 70, "seed": 1}, simulate={"duration": 1e-3, "steps": 4})
    )
    cost = estimate(plan, plan.simulated)
    assert (cost.simulations, cost.lanes) == (70 * 4, 64)  # 1.7 times two iterations, rounded up
    assert cost.seconds == pytest.approx(4 * 2 * cost.batch_seconds + cost.once)
    assert cost.once > cost.batch_seconds
    sweep = {"rod.laminate.angles[0]": {"from": 0, "to": 1, "count": 9}}
    plan = load_study(write(sweep=sweep, starts=None, optimizer=None, simulate={"duration": 1e-3, "steps": 4}))
    assert estimate(plan, plan.simulated).simulations == 10  # with the start design


@pytest.mark.thorough
def test_the_time_is_that_of_a_batch(write, monkeypatch):
    """By a clock that only simulations move: two short motions tell what the structure stage and a step take."""
    plan = load_study(write(simulate={"duration": 0.01, "steps": 60}))
    problem, clock = plan.simulated, [0.0]
    bytes_of_a_motion = problem.motion(problem.start).q[0].numel() * 8

    def counted(simulation, designs, *others):
        lanes = len(next(iter(designs.values())))
        clock[0] += 1.0 + 0.125 * simulation.steps * lanes
        return simulate(simulation, designs, *others)

    monkeypatch.setattr(Simulation, "__call__", counted)
    monkeypatch.setattr("torchmbd.study.estimate.time", clock_of(clock))
    cost = estimate(plan, problem)
    assert cost.batch_seconds == pytest.approx(1.0 + 0.125 * 60 * 2, rel=1e-12)  # of two starts
    assert cost.memory > 3 * 2 * bytes_of_a_motion


@pytest.mark.thorough
def test_the_cost_of_a_valid_file(write):
    output = io.StringIO()
    print_estimate(load_study(write(simulate={"duration": 1e-3, "steps": 4})), Console(file=output, width=200))
    text = output.getvalue()
    assert "is valid: integral of strain energy of rod, 2 design variables, 1 constraint" in text
    assert "at most about 8 simulations in batches of 2" in text
    assert "of them once (loading, pictures, MLflow)" in text
    assert (
        "gradients: reverse mode, chosen by an estimate," in text
        or "gradients: forward mode, chosen by an estimate," in text
    )
    assert "reverse mode" in text
    assert "forward mode" in text
    assert "retained modes: make joints and forces" in text  # what these leave out (diagnosis/truncation.py)


@pytest.mark.thorough
def test_phases_that_begin_after_the_part_that_is_measured(write):
    plan = load_study(write(simulate={"duration": 0.008, "steps": 40, "phases": "rod_model.py:in_two"}))
    whole = plan.simulated.simulation
    assert [phase.until for phase in whole.beginning(0.006, 30).phases] == [0.004, None]
    assert [phase.until for phase in whole.beginning(0.004, 20).phases] == [None]
    lasting = [mbd.Phase(lasting=0.003), mbd.Phase(lasting=0.003), mbd.Phase()]
    assert [phase.lasting for phase in phases_within(lasting, 0.005)] == [0.003, None]
    assert phases_within(lasting, 0.01) == lasting
    assert estimate(plan, plan.simulated).batch_seconds > 0.0


@pytest.mark.thorough
def test_responses_count(write, monkeypatch):
    """By a clock that only the response moves: the estimate is what a batch takes, of the whole motion."""
    clock = [0.0]

    def slow(motion):
        clock[0] += 0.02 * motion.t.numel()
        return motion.body("rod").strain_energy

    monkeypatch.setattr("torchmbd.study.estimate.time", clock_of(clock))
    plan = load_study(write(simulate={"duration": 0.01, "steps": 60}, subject_to=[]))
    asked = mbd.Integral(mbd.history(slow), window=(0.005, 0.01))  # not in the part that is measured
    problem = mbd.Problem(plan.simulated.system, 0.01, asked, steps=60, bounds=(-1.5, 1.5))
    cost, began = estimate(plan, problem).batch_seconds, clock[0]
    problem.evaluate(np.tile(problem.start, (2, 1)), True)
    assert cost == pytest.approx(clock[0] - began, rel=1e-9)
    assert cost > 0.02 * 60


@pytest.mark.thorough
def test_scenarios_of_several_systems_count(monkeypatch):
    """By a clock that only simulations move: every batch simulates each system with a lane for each of its scenarios."""
    clock, light, heavy = [0.0], mbd.examples.arm(), mbd.examples.arm()

    def counted(simulation, designs, *others):
        clock[0] += len(next(iter(designs.values())))
        return simulate(simulation, designs, *others)

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
    study = SimpleNamespace(problem=problem, sweep=None, points=points, max_iterations=4)
    cost = estimate(study, problem)
    assert (cost.simulations, cost.lanes) == (2 * 7 * 3, 2 * 3)
    assert cost.batch_seconds == pytest.approx(6.0)
