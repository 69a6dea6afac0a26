"""Optimizers find the same design whatever the units and the constant part of objective, constraints and variables.

Over the registry of optimizers, and over all ways to minimize the largest of several numbers: rows of a Problem, Scenarios,
RobustProblem.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import torchmbd as mbd
from tests.contracts.test_optimizers import GRADIENT_FREE, METHODS, solve
from tests.optimization.analytic import Analytic
from torchmbd.optimization import Evaluation, OptimizationResult, RobustProblem, optimize

ALL = [*METHODS, *GRADIENT_FREE]


class Changed:
    """A problem in other units: unit f(x variable) + constant, limit c(x variable) <= 0."""

    def __init__(
        self, problem: Any, constant: float = 0.0, unit: float = 1.0, variable: Any = 1.0, limit: float = 1.0
    ) -> None:
        self.problem, self.constant, self.unit, self.limit = problem, constant, unit, limit
        self.variable = np.broadcast_to(np.asarray(variable, dtype=float), problem.start.shape)
        self.names = problem.names
        self.start, self.lower, self.upper = (x / self.variable for x in (problem.start, problem.lower, problem.upper))

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        inner = np.clip(X * self.variable, self.problem.lower, self.problem.upper)
        return [self._changed(e) for e in self.problem.evaluate(inner, gradients)]

    def _changed(self, e: Evaluation) -> Evaluation:
        df, dc = e.objective_gradient, e.constraint_gradients
        return replace(
            e,
            objective=self.unit * e.objective + self.constant,
            objective_gradient=None if df is None else self.unit * df * self.variable,
            constraints=self.limit * e.constraints,
            constraint_gradients=None if dc is None else self.limit * dc * self.variable,
        )


def valley() -> Analytic:
    """Least on the line x1 + x2 = 1, not at the minimum (0.85, 0.5) of the objective beyond it."""
    return Analytic(
        "valley",
        [0.2, -0.7],
        lambda x: (x[0] - 1.0) ** 2 + (x[1] - 0.5) ** 2 + 0.3 * x[0],
        lambda x: [x[0] + x[1] - 1.0],
        lower=-2.0,
        upper=2.0,
    )


VALLEY = np.array([0.675, 0.325])  # 2 (x1 - 1) + 0.3 = 2 (x2 - 0.5), the gradients along the constraint
LEAST = float(valley().f(VALLEY).real)
START = float(valley().f(valley().start).real)


def check(result: OptimizationResult, wanted: np.ndarray, size: Any = 1.0) -> None:
    np.testing.assert_allclose(result.x / size, wanted / size, atol=2e-3)
    assert result.status == "converged", result.message
    assert result.kkt_residual <= 1e-3


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("constant", [-1e4, -30.0, -START, -LEAST, 0.0, 1.0, 1e3, 1e6])
def test_a_constant_in_the_objective_changes_no_optimum(method, constant):
    """Also where the objective is zero at the start, or at the optimum."""
    if constant == -LEAST and method in GRADIENT_FREE:
        pytest.skip("relative to an objective of zero, the residual of a method without gradients is no measure")
    check(solve(Changed(valley(), constant), method, max_iterations=300), VALLEY)


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e5])
@pytest.mark.parametrize("constant", [0.0, -0.5])
def test_the_unit_of_the_objective_changes_no_optimum(method, unit, constant):
    check(solve(Changed(valley(), constant * unit, unit), method, max_iterations=300), VALLEY)


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("units", [(1e-3, 1e3), (1e-6, 1e-6), (50.0, 0.02)])
def test_units_of_variables_change_no_optimum(method, units):
    size = 1.0 / np.array(units)
    check(solve(Changed(valley(), 2.0, variable=units), method, max_iterations=300), VALLEY * size, size)


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_a_constraint_changes_no_optimum(method, unit):
    """The violation that counts as none is in the unit of the constraint."""
    result = solve(Changed(valley(), -1.0, limit=unit), method, max_iterations=300, feasibility=1e-6 * unit)
    check(result, VALLEY)


@pytest.mark.parametrize("method", ALL)
@pytest.mark.parametrize("constant", [-1.0, 0.0, 1e4])
def test_a_start_without_gradient_does_not_set_the_unit(method, constant):
    """At 90 degrees the gradient vanishes by symmetry: the unit is that of the design aside."""
    symmetric = Analytic(
        "symmetric", [90.0], lambda x: constant - 1e-4 * np.cos(x[0] * np.pi / 90), lower=-90, upper=90
    )
    result = solve(symmetric, method, max_iterations=300)
    assert result.status == "converged"
    assert result.x[0] == pytest.approx(0.0, abs=0.1)


def tilted(constant: float, unit: float = 1.0) -> Changed:
    """Its worst case within 0.1 is least at (-0.2, 0.4), by symmetry: (|x1 + 0.2| + 0.1)^2 + 2 (|x2 - 0.4| + 0.1)^2."""
    bowl = Analytic("bowl", [1.0, -1.0], lambda x: (x[0] + 0.2) ** 2 + 2.0 * (x[1] - 0.4) ** 2, lower=-2.0, upper=2.0)
    return Changed(bowl, constant * unit, unit)


WORST = 0.03  # 0.1^2 + 2 0.1^2
WORST_AT_START = 1.3**2 + 2.0 * 1.5**2


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e5])
@pytest.mark.parametrize("constant", [-1e3, -WORST_AT_START, -2.0, -WORST, 0.0, 1e3])
def test_the_worst_case_within_tolerances_has_any_sign(method, constant, unit):
    result = solve(RobustProblem(tilted(constant, unit), 0.1, "worst"), method, max_iterations=300)
    assert result.status == "converged", result.message
    np.testing.assert_allclose(result.x[:2], [-0.2, 0.4], atol=0.02)
    assert (result.value / unit - constant - WORST) == pytest.approx(0.0, abs=3e-4)


def pushed(position: float, **options: Any) -> dict[str, Any]:
    """A block that starts at x = `position`, pushed by its design variable and by a wind, for one second."""
    ground = mbd.Ground()
    block = mbd.RigidBody("block", 1.0, (0.01,) * 3, position=(position, 0, 0))
    slide = mbd.Prismatic(ground.at(), block.at(), axis="x")
    forces = [mbd.Force(block.at(), (mbd.variable(x), 0, 0), name=name) for name, x in (("push", 10.0), ("wind", 1.0))]
    system = mbd.System([block], [slide], forces)
    return {"system": system, "duration": 1.0, "variables": ["push.x"], "bounds": (-20.0, 20.0), "steps": 8} | options


WHERE = mbd.Position("block", "x")  # position + (push + wind) t^2 / 2
PLACES = [-100.0, -5.5, 0.5]  # of the start: with -5.5 the largest row is zero there


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("method", ["mmfd", "sqcqp", "slsqp", "mma"])
def test_scenarios_have_any_sign(method, place):
    cases = {"calm": {"wind.x": 0.0}, "wind": {"wind.x": 2.0}}
    result = optimize(mbd.Scenarios(**pushed(place, minimize=mbd.Final(WHERE), scenarios=cases)), method)
    assert result.status == "converged", result.message
    assert result.x[0] == pytest.approx(-20.0, abs=1e-3)
    assert result.value == pytest.approx(place - 9.0, abs=1e-3)


@pytest.mark.thorough
def test_scenarios_without_gradients():
    """The extra variable has no finite bounds, and is not drawn."""
    cases = {"calm": {"wind.x": 0.0}, "wind": {"wind.x": 2.0}}
    problem = mbd.Scenarios(**pushed(0.5, minimize=mbd.Final(WHERE), scenarios=cases))
    result = optimize(problem, "differential_evolution", population=5)
    assert result.status == "converged", result.message
    assert result.value == pytest.approx(-8.5, rel=1e-3)  # the Kuhn-Tucker residual that is asked for


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("method", ["mmfd", "sqcqp", "slsqp"])
def test_rows_of_a_problem_have_any_sign(method, place):
    """(x(t) - place - 1)^2 - 3 at three times: the largest row is that of the begin, 1 - 3, where push is small enough."""
    away = WHERE - (place + 1.0)
    squared = mbd.AtTimes(away * away - 3.0, times=(0.0, 0.5, 1.0))
    result = optimize(
        mbd.Problem(
            **pushed(
                place,
                minimize=squared,
            )
        ),
        method,
    )
    assert result.value == pytest.approx(-2.0, abs=1e-4)
    assert result.status == "converged", result.message
