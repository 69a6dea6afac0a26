"""What is reported of a min-max problem is the largest row of a design, whatever its extra variable was."""

from __future__ import annotations

import numpy as np
import pytest

from torchmbd.optimization import Evaluation, multistart, optimize
from torchmbd.optimization.extra_variable import ExtraVariable

UNIT = 4.0
EXTRA = ExtraVariable(3, UNIT, UNIT, 1.0)  # y_0 is its own unit: the objective is beta UNIT


def rows(x: np.ndarray) -> np.ndarray:
    """Three parabolas of two variables; their largest is least, 4/3 + 1/4, where the lower two are equal."""
    a, b = x
    return np.array([(a - 1.0) ** 2 + b**2 + 0.5, 0.5 * (a + 1.0) ** 2 + b**2 + 0.25, 0.25 + (b - 1.0) ** 2])


def slopes(x: np.ndarray) -> np.ndarray:
    a, b = x
    return np.array([[2.0 * (a - 1.0), 2.0 * b], [a + 1.0, 2.0 * b], [0.0, 2.0 * (b - 1.0)]])


class Largest:
    """Minimize beta UNIT, where every row / UNIT is at most beta, and a is at most 0.6."""

    names = ("a", "b", "beta")
    has_extra_variable = True
    start, lower, upper = np.array([0.5, 0.8, 1.0]), np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 1.0])

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        return [self.one(x) for x in X]

    def one(self, x: np.ndarray) -> Evaluation:
        values = np.append(rows(x[:2]) / UNIT - x[2], x[0] - 0.6)
        dc = np.zeros((4, 3))
        dc[:3, :2], dc[:3, 2], dc[3, 0] = slopes(x[:2]) / UNIT, -1.0, 1.0
        return Evaluation(float(UNIT * x[2]), values, np.array([0.0, 0.0, UNIT]), dc)

    def with_least_bound(self, x: np.ndarray, evaluation: Evaluation) -> tuple[np.ndarray, Evaluation]:
        return EXTRA.tightened(x, evaluation)


@pytest.mark.parametrize("beta", [0.0, 1e-9, 0.3, 1.0])
def test_it_is_the_largest_row_from_above_and_below(beta):
    problem = Largest()
    x = np.array([0.3, 0.1, beta])
    closed, result = EXTRA.tightened(x, problem.one(x))
    assert result.objective == pytest.approx(rows(x[:2]).max(), rel=1e-14)
    again = problem.one(closed)
    assert again.objective == pytest.approx(result.objective, rel=1e-14)
    np.testing.assert_allclose(again.constraints, result.constraints, atol=1e-14)
    assert EXTRA.tightened(closed, result)[0] is closed


def test_it_stays_in_its_bounds_and_a_failure_is_left_alone():
    problem, x = Largest(), np.array([-1.9, 1.9, 0.5])
    closed, result = EXTRA.tightened(x, problem.one(x))
    assert closed[-1] == 1.0
    assert result.constraints[:3].max() == pytest.approx(rows(x[:2]).max() / UNIT - 1.0)
    failed = Evaluation.failure("failed: no", 4)
    assert EXTRA.tightened(x, failed)[1] is failed


@pytest.mark.parametrize("method", ["mmfd", "sqcqp", "slsqp", "mma", "trust-constr"])
@pytest.mark.parametrize("iterations", [1, 2, 60])
def test_every_iterate_of_every_method_is_its_largest_row(method, iterations):
    found = multistart(
        Largest(), method, [[0.5, 0.8, 1.0], [-0.5, -0.4, 0.0], [0.1, 0.2, 0.01]], max_iterations=iterations
    )
    for result in found.results:
        for value, x, violation in [
            (result.value, result.x, result.violation),
            *((i.objective, i.x, i.violation) for i in result.history),
        ]:
            assert value == pytest.approx(min(rows(x[:2]).max(), UNIT), rel=1e-9)
            assert violation == pytest.approx(max(x[0] - 0.6, rows(x[:2]).max() / UNIT - 1.0, 0.0), abs=1e-9)
    assert found.best is not None
    assert found.best.violation <= 1e-6


def test_a_few_iterations_are_an_honest_bound_of_the_optimum():
    long = optimize(Largest(), "slsqp", max_iterations=100)
    short = optimize(Largest(), "slsqp", max_iterations=3, start=np.array([0.4, 0.0, 1e-6]))
    assert long.value <= short.value * (1.0 + 1e-9)
    assert short.value < rows(np.array([0.4, 0.0])).max() + 1e-9
