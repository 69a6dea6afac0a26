"""Finite differences as a route to gradients: orders of error, the same results object, failures of neighbors, bad input."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import ANY, refused
from torchmbd.design.differences import Differences, differences
from torchmbd.optimization import Evaluation

pytestmark = pytest.mark.usefixtures("compiled")

ENERGY = mbd.StrainEnergy("rod")
AT = np.radians([[20.0, -50.0], [70.0, 15.0]])


@pytest.fixture(scope="module")
def problem() -> mbd.Problem:
    tight = {"steps": 12, "iterations": (6, 6), "refresh": 1}
    limited = [mbd.Max(ENERGY) <= "initial"]
    return mbd.Problem(pendulum(), 0.03, mbd.Integral(ENERGY), limited, mbd.deg([-90, 90]), **tight)


def cubic(X: np.ndarray) -> np.ndarray:
    """A function of two variables with a vector of three values [lanes, 3]."""
    x, y = X.T
    return np.stack([x**3, x * y, y**2 - x], -1)


def test_errors_are_those_of_the_taylor_series():
    X, h = np.array([[0.3, -1.2], [2.0, 0.7]]), 0.01
    x, y = X.T
    one, zero = np.ones(2), np.zeros(2)
    exact = np.stack([np.stack(row, -1) for row in ((3 * x**2, zero), (y, x), (-one, 2 * y))], 1)
    values, central = differences(cubic, X, h)
    np.testing.assert_allclose(values, cubic(X))
    error = np.zeros_like(exact)
    error[:, 0, 0] = (h / 2) ** 2
    np.testing.assert_allclose(central, exact + error, atol=1e-12)
    _, forward = differences(cubic, X, [h, 2 * h], "forward")
    error[:, 0, 0] = 3 * x * h + h**2
    error[:, 2, 1] = 2 * h
    np.testing.assert_allclose(forward, exact + error, atol=1e-12)
    _, own = differences(cubic, X, [[h, h], [3 * h, h]], "forward")  # of every design its own
    np.testing.assert_allclose(own[:, 0, 0], 3 * x**2 + 3 * x * h * [1, 3] + (h * np.array([1, 3])) ** 2)
    _, backward = differences(cubic, X, h, "forward", upper=X.max())
    np.testing.assert_allclose(backward[1, 0, 0], (3 * x**2 - 3 * x * h + h**2)[1])  # at the bound: backward
    np.testing.assert_allclose(backward[0, 0, 0], (3 * x**2 + 3 * x * h + h**2)[0])


@pytest.mark.thorough
@pytest.mark.parametrize(("scheme", "step", "tolerance"), [("central", 1e-3, 1e-5), ("forward", 1e-6, 1e-4)])
def test_the_same_object_as_the_exact_route(problem, scheme, step, tolerance):
    exact = problem.evaluate(AT, gradients=True)
    result = Differences(problem, step, scheme).evaluate(AT, gradients=True)
    assert [type(e) for e in result] == [Evaluation, Evaluation]
    for a, b in zip(result, exact, strict=True):
        assert a.objective == pytest.approx(b.objective, rel=1e-9)
        assert a.constraints == pytest.approx(b.constraints, rel=1e-6, abs=1e-9)
        for x, y in ((a.objective_gradient, b.objective_gradient), (a.constraint_gradients, b.constraint_gradients)):
            assert x.shape == y.shape
            assert np.abs(x - y).max() < tolerance * np.abs(y).max()


@pytest.mark.thorough
def test_optimizers_take_it_as_they_take_the_problem(problem):
    wrapped = Differences(problem, 1e-4)
    assert (wrapped.names, wrapped.limits) == (problem.names, problem.limits)
    assert wrapped.evaluate(AT, gradients=False)[0].objective_gradient is None
    by_differences = mbd.optimize(wrapped, method="slsqp", max_iterations=2)
    exact = mbd.optimize(problem, method="slsqp", max_iterations=2)
    assert by_differences.value == pytest.approx(exact.value, rel=1e-4)
    assert by_differences.value < by_differences.history[0].objective


class _Fails:
    """A problem whose designs fail beyond 1."""

    start, lower = np.zeros(1), np.full(1, -np.inf)
    names = ("x",)
    upper = np.array([2.0])

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        return [
            Evaluation(float(x), np.array([x])) if x <= 1 else Evaluation.failure("failed: too far", 1) for [x] in X
        ]


def test_a_neighbor_that_fails_fails_its_design_alone():
    result = Differences(_Fails(), 0.1, "forward").evaluate(np.array([[0.5], [0.95], [1.5]]), gradients=True)
    assert [e.status for e in result] == ["ok", "failed: a neighbor of the design: failed: too far", "failed: too far"]
    assert result[0].objective_gradient == pytest.approx([1.0])
    assert result[0].constraint_gradients == pytest.approx(np.ones((1, 1)))
    assert np.isnan(result[1].objective)


@pytest.mark.parametrize(
    ("step", "scheme", "fault"),
    [
        (0.0, "central", ("step", 0.0)),
        (np.nan, "central", ("step",)),
        ([1e-3] * 3, "central", ("step", ANY, "(3,)")),
        (1e-3, "centrel", ("scheme", "centrel", "'central'")),
    ],
)
def test_bad_input_is_named(problem, step, scheme, fault):
    with refused(*fault):
        Differences(problem, step, scheme)
    with refused(*fault):
        differences(cubic, AT, step, scheme)


@pytest.mark.parametrize("scheme", ["central", "forward"])
def test_a_step_below_rounding_is_refused(scheme):
    with refused("step", 1e-14):
        differences(cubic, np.array([[1e3, 1e3]]), 1e-14, scheme)
