"""Optima in a finer model: gains that hold, artifacts of the steps, constraints that fail, orders that change."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from torchmbd.design.problem_parts import masses_and_frequencies
from torchmbd.design.verification import (
    _constrained,
    _faults_of_constraints,
    _faults_of_gain,
    _holds,
    _Response,
    advice,
    verification,
)
from torchmbd.design.words import words
from torchmbd.optimization import MultistartResult
from torchmbd.results.answer import Verification
from torchmbd.results.response_error import ResponseError

pytestmark = pytest.mark.usefixtures("compiled")

X = mbd.Position("bob", "x")
ENERGY = mbd.StrainEnergy("arm")


def oscillator(frequency: float = 40.0) -> mbd.System:
    """A mass of 1 kg on a spring, pushed at the start: x = v0/omega sin(omega t); its speed v0 is a variable."""
    stiffness = (2.0 * math.pi * frequency) ** 2
    bob = mbd.RigidBody("bob", mbd.variable(1.0), (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    ground = mbd.Ground()
    spring = mbd.SpringDamper(ground.at(-1.0, 0.0, 0.0), bob.at(), stiffness=stiffness, rest=1.0)
    return mbd.System([bob], [mbd.Prismatic(ground.at(), bob.at(), axis="x")], [spring])


def vibrating(steps: int, **options: Any) -> mbd.Problem:
    """Which mass lets the oscillator rest after a tenth of a second?"""
    asked: dict[str, Any] = {"minimize": mbd.Final(X) ** 2, "variables": ["bob.mass"], "bounds": (0.8, 1.25)}
    return mbd.Problem(oscillator(), 0.1, steps=steps, **asked | options)


def least(problem: mbd.Problem, count: int = 41) -> tuple[np.ndarray, float]:
    """The best of many masses, as an optimizer finds it: the design whose error is in its favor."""
    designs = np.linspace(0.8, 1.25, count)[:, None]
    values = [
        e.objective if e.violation_ok else math.inf for e in map(_with_violation, problem.evaluate(designs, False))
    ]
    k = int(np.argmin(values))
    return designs[k], values[k]


def _with_violation(evaluation: Any) -> Any:
    return SimpleNamespace(objective=evaluation.objective, violation_ok=(evaluation.constraints <= 0.0).all())


@pytest.mark.thorough
def test_a_gain_that_steps_resolve_is_verified() -> None:
    """Its error and the gain in the finer model are those of a run with eight times the steps."""
    problem, exact = (vibrating(n, minimize=mbd.Integral(X * X)) for n in (80, 640))
    x, value = least(problem)
    result = verification(problem, x, value)
    assert result.verified, result.status
    true = [e.objective for e in exact.evaluate(np.stack([problem.start, x]), False)]
    objective = result.answers[0]
    assert objective.best.value == pytest.approx(value, rel=1e-12)
    assert objective.best.error == pytest.approx(true[1] - value, rel=0.1)
    assert result.finer == pytest.approx(100.0 * (true[1] - true[0]) / true[0], rel=1e-2)
    assert result.status.startswith("verified: the objective changed by -")


@pytest.mark.thorough
def test_an_artifact_of_the_steps_is_not_verified() -> None:
    """Two steps a period: the least of many designs is a number of the steps, not of the oscillator."""
    problem = vibrating(8)
    x, value = least(problem)
    result = verification(problem, x, value)
    assert not result.verified
    assert result.status.startswith("not verified: ")
    assert "Try: steps: " in result.status
    assert "not resolved" in result.status or "in the finer model" in result.status


@pytest.mark.thorough
def test_a_constraint_that_fails_in_the_finer_model() -> None:
    """Six steps a period make the mean square too small. An upper limit that is active there fails."""
    x, square = np.array([1.0]), mbd.Integral(X * X)
    given: dict[str, Any] = {"minimize": mbd.Mass("bob"), "start": [1.05]}
    numbers = [square(vibrating(steps).motion(x)).item() for steps in (24, 96)]
    problem = vibrating(24, subject_to=[square <= numbers[0]], **given)
    result = verification(problem, x, 1.0)
    assert "integral of x position of bob · x position of bob is beyond its limit by" in result.status
    assert "steps: " in result.advice
    [row] = [one for one in result.answers if one.goal == "at most"]
    assert row.active
    assert row.best.finer == pytest.approx(numbers[1], rel=0.02)
    assert row.finer == pytest.approx(1.0 - numbers[1] / numbers[0], abs=0.02)
    loose = vibrating(24, subject_to=[square <= 1.2 * numbers[0]], **given)
    assert verification(loose, x, 1.0).verified


def test_limits_of_the_initial_design_are_those_of_the_finer_model() -> None:
    """The same peak at start and best design: the limit "initial" has its error too."""
    problem = vibrating(32, minimize=mbd.Integral(X * X), subject_to=[mbd.Max(X) <= "initial"])
    same = verification(problem, problem.start, problem.evaluate(problem.start[None], False)[0].objective)
    assert same.verified, same.status
    assert same.answers[1].finer == pytest.approx(0.0, abs=1e-12)
    assert same.answers[1].limit == pytest.approx(same.answers[1].best.value)


@pytest.mark.thorough
def test_an_order_of_starts_that_changes() -> None:
    """Among ends that lie within the error of the best one, another is better in the finer model."""
    problem, exact = vibrating(24), vibrating(320)
    designs = np.linspace(0.8, 1.25, 41)[:, None]
    coarse, fine = ([e.objective for e in one.evaluate(designs, False)] for one in (problem, exact))
    best = int(np.argmin(coarse))
    near = [k for k in np.argsort(coarse) if fine[k] < 0.2 * fine[best]][:3]
    ends: Any = [SimpleNamespace(x=designs[k], value=coarse[k], start=int(k)) for k in near]
    result = verification(problem, designs[best], coarse[best], ends)
    assert not result.verified
    assert any("is better in the finer model" in fault for fault in result.faults), result.status


def test_a_shell_held_at_one_node_shows_no_frequencies_of_its_own() -> None:
    """Its first frequency falls from 233 Hz to 118 Hz as cells become half as long: no number of the body."""
    laminate = mbd.Laminate(mbd.examples.carbon(), torch.nn.Parameter(mbd.deg([30.0])), thickness=2e-3)
    mesh = mbd.mesh.rectangle(length=0.5, width=0.1, cells=(4, 2))
    for held, count in {"middle": 0, "left_edge": 2}.items():
        reference = None if held == "middle" else held
        body = mbd.FlexibleBody.plate("arm", mesh, laminate, modes=4, reference=reference)
        problem = mbd.Problem(
            mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("left"))]),
            0.01,
            mbd.Integral(ENERGY),
            steps=4,
            bounds=mbd.deg([-90, 90]),
        )
        names = [words(measure) for measure in masses_and_frequencies(problem, 2)]
        assert names == ["mass of arm", "frequency of arm", "frequency 2 of arm"][: 1 + count]


@pytest.mark.thorough
def test_results_of_optimize_and_multistart() -> None:
    energy = mbd.Integral(ENERGY)
    problem = mbd.Problem(
        mbd.examples.arm(),
        0.05,
        maximize=-energy,
        steps=40,
        subject_to=[
            mbd.Max(mbd.Displacement("arm", "z", node="right")) <= 0.5,
            mbd.Mass("arm") <= "initial",
            mbd.Frequency("arm") >= 1.0,
        ],
        bounds=mbd.deg([-90, 90]),
    )
    result = mbd.optimization.multistart(problem, starts=mbd.optimization.sobol(2, seed=1), max_iterations=2)
    for one in (result, result.best):
        assert one is not None
        found = mbd.verify(one)
        assert [row.goal for row in found.answers] == ["maximize", "at most", "at most", "at least"]
        assert found.answers[0].best.value == pytest.approx(-result.best.value, rel=1e-9)
        assert found.answers[2].words == "mass of arm"
        assert found.answers[2].unit == "kg"
        assert found.answers[2].active
        assert found.answers[3].words == "frequency of arm"
        frequency = found.answers[3].best  # it has an error by the mesh alone
        assert 0.0 < abs(frequency.error) < 0.1 * frequency.value
        start, best = found.answers[0].start, found.answers[0].best
        unresolved = abs(best.error - start.error) > 0.1 * abs(best.value - start.value)
        assert [fault.partition(" of ")[0] for fault in found.faults] == (["the gain"] if unresolved else [])
        assert "maximize" in repr(found)
    assert Verification.from_json(found.to_json()) == found


@pytest.mark.thorough
@pytest.mark.parametrize("rule", ["worst", "mean"])
def test_scenarios(rule: str) -> None:
    cases = {"thin": {"arm.laminate.thickness": 1e-3}, "thick": {"arm.laminate.thickness": 2e-3}}
    given: dict[str, Any] = {"variables": ["arm.laminate.angles"], "scenarios": cases, "objective": rule}
    limits = [mbd.Max(ENERGY) <= "initial"]
    problem = mbd.Scenarios(mbd.examples.arm(), 0.05, mbd.Max(ENERGY), limits, steps=20, **given)
    exact = mbd.Scenarios(mbd.examples.arm(), 0.05, mbd.Max(ENERGY), limits, steps=160, **given)
    x = problem.start + np.append(np.radians([5.0, 5.0]), [0.0] * (rule == "worst"))
    result = verification(problem, x, problem.evaluate(x[None], False)[0].objective)
    names = list(cases)
    values = [[float(mbd.Max(ENERGY)(p.simulate(x[None], scenario=n))[0]) for n in names] for p in (problem, exact)]
    joined = [max(row) if rule == "worst" else sum(row) / 2.0 for row in values]
    assert result.answers[0].best.value == pytest.approx(joined[0], rel=1e-9)
    objective, constraint = problem.errors(x)
    assert objective.by_modes is not None
    worst = int(objective.value[0].argmax())
    assert 0.5 < objective.by_steps[0, worst].item() / (joined[1] - joined[0]) < 2.0
    assert objective.by_mesh is not None
    every = objective.by_steps + objective.by_modes + objective.by_mesh
    assert result.answers[0].best.error == pytest.approx(every[0, worst].item(), rel=1e-6)
    assert objective.value.shape == (1, 2 if rule == "worst" else 1)
    assert constraint.value.shape == (1, 2)


@pytest.mark.thorough
def test_tolerances_are_verified_at_the_nominal_design() -> None:
    inner = mbd.Problem(mbd.examples.arm(), 0.05, mbd.Integral(ENERGY), steps=40, bounds=mbd.deg([-90, 90]))
    robust = mbd.optimization.RobustProblem(inner, mbd.deg(2.0), "worst")
    result = mbd.optimize(robust, max_iterations=2)
    found = mbd.verify(result)
    assert found.verified, found.status
    # The change is that of the worst case, not of the nominal design.
    first = max(e.objective for e in inner.evaluate(inner.start + robust.shifts, False))
    assert found.change == pytest.approx(100.0 * (result.value - first) / first, rel=1e-9)
    assert "worst case" in found.notes[-1]
    assert any("nominal design" in note for note in found.notes)


@pytest.mark.thorough
def test_a_method_without_an_estimate_is_not_verified() -> None:
    problem = vibrating(20, method="rk4")
    result = verification(problem, np.array([1.1]), 0.0)
    assert "= 'rk4': must be generalized_alpha" in result.status
    assert not result.verified


def test_a_status_tells_what_the_search_did() -> None:
    search = (
        "not converged (stalled: no step improves); better than the start (objective 2); 31 evaluations, none failed"
    )
    sound = Verification((), -10.0, -9.8, (), search=search)
    assert sound.verified
    assert sound.status.startswith("verified: the objective changed by -10.00 %, in a finer model by -9.80 %")
    assert sound.status.endswith(search)
    failing = Verification((), -10.0, -9.8, (), search=search, failing="17 of 31 evaluations failed, 14 of them: no")
    assert not failing.verified
    assert failing.status.startswith("many evaluations failed: 17 of 31 evaluations failed, 14 of them: no; ")
    assert Verification.from_json(failing.to_json()) == failing


@pytest.mark.thorough
def test_a_best_design_that_is_worse_than_the_start_is_not_verified() -> None:
    problem = vibrating(80, minimize=mbd.Integral(X * X), backend="eager")
    x = np.array([1.2])
    result = verification(problem, x, problem.evaluate(x[None], False)[0].objective)
    assert result.change > 0.0
    assert any("worse than the start" in fault for fault in result.faults)


def test_bad_input() -> None:
    with refused("result", 3):
        mbd.verify(3)  # pyright: ignore[reportArgumentType]
    with refused("result"):
        mbd.verify(MultistartResult([], []))


@pytest.mark.parametrize("far", [0.0, -5.0, -1e6])
@pytest.mark.parametrize(("excess", "holds"), [(0.0001, True), (0.005, False), (math.nan, False)])
def test_rows_far_from_the_limit_do_not_change_the_verdict_on_others(far: float, excess: float, holds: bool) -> None:
    """Two rows below 0.02: one near it, the other at `far`, with a size of its own."""
    value = torch.tensor([[0.02, far]] * 2, dtype=torch.float64)
    by_steps = torch.tensor([[excess, 0.0]] * 2, dtype=torch.float64)
    error = ResponseError("", value, value.abs(), value.abs(), by_steps, torch.ones(2, dtype=torch.bool), ("", ""))
    limits = np.full(2, 0.02)
    response = _constrained(mbd.Max(X) <= 0.02, error, limits, limits, np.full(2, 0.02))
    faults = _faults_of_constraints([response], 1)
    assert (not faults) is holds
    assert _holds([response], 1) is holds
    if excess == 0.005:
        assert faults[0].text.endswith("is beyond its limit by 25 % in the finer model, and at most 1 % is accepted")
        assert faults[0].need == pytest.approx(25.0)


def test_advice_names_what_the_errors_come_from() -> None:
    problem = vibrating(80)
    assert advice(problem, 4.0, {"mesh"}) == "finer meshes of the flexible bodies"
    assert advice(problem, 4.0, {"steps", "mesh"}) == "finer meshes of the flexible bodies and steps: 160 or more"
    assert advice(problem, 4.0) == "steps: 160 or more"


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize(("start", "verified"), [(1.0, True), (3e-13, False)])
def test_an_optimum_of_almost_zero_is_judged_beside_the_gain(unit: float, start: float, verified: bool) -> None:
    """The digits of 1e-13 do not converge with the steps, which matters only for a gain of this size."""
    value, by_steps = (unit * torch.tensor(x, dtype=torch.float64) for x in ([start, 1e-13], [1e-9 * start, 2e-13]))
    error = ResponseError("f", value, value, value, by_steps, torch.tensor([True, False]), ("", "by chance"))
    response = _Response("minimize", mbd.Integral(ENERGY), value.numpy(), (value + by_steps).numpy(), error)
    assert (response.reasons == ("", "")) is verified
    assert (not _faults_of_gain(response, claimed=True)) is verified
