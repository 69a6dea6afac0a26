"""The ends of methods of other packages: Kuhn-Tucker points, also where the limit that holds an optimum curves a lot."""

from __future__ import annotations

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize


def tube(curvature: float, weights: list[float]) -> Analytic:
    """Least wall x[0] of a deflection that grows with the squares of angles: 1 where all of them are 0."""
    w = np.array(weights)

    def limit(x: np.ndarray) -> list[complex]:
        squares = x[1:] ** 2
        return [(1.0 + curvature * (w @ squares) / (1.0 + 2.0 * squares.sum())) / x[0] - 1.0]

    start, bound = [0.3, -0.6, 1.0][: len(w)], [1.57] * len(w)
    lower, upper = [0.1, *(-x for x in bound)], [9.0, *bound]
    return Analytic("tube", [1.0, *start], lambda x: x[0], limit, lower=lower, upper=upper, optimum=1.0)


CURVED = [
    ("mma", 15.0, [1.0]),
    ("mma", 40.0, [1.0, 2.0]),
    ("slsqp", 40.0, [1.0, 2.0]),
    ("slsqp", 40.0, [1.0, 10.0, 100.0]),
]


@pytest.mark.parametrize(("method", "curvature", "weights"), CURVED)
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_a_curved_optimum_is_a_kuhn_tucker_point(method, curvature, weights, unit):
    problem = tube(curvature, weights)
    f = problem.f
    problem.f = lambda x: unit * f(x)
    result = optimize(problem, method, kkt=1e-4, max_iterations=300, progress=False)
    assert result.status == "converged", result.message
    assert result.kkt_residual <= 1e-4
    assert result.value == pytest.approx(unit, rel=1e-5)
    assert result.violation <= result.feasibility
    assert result.analyses < 400


@pytest.mark.parametrize("limit", [5, 12, 14, 15])
def test_a_limit_of_analyses_ends_quadratic_steps_as_well(limit):
    result = optimize(tube(40.0, [1.0, 2.0]), "slsqp", kkt=1e-4, max_analyses=limit, progress=False)
    assert result.analyses <= limit
    assert result.status in ("converged", "max_iterations", "infeasible")
