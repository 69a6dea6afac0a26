"""The search: scaling, cache and the best design seen."""

import numpy as np

from tests.optimization.analytic import Analytic
from torchmbd.optimization.search import Search
from torchmbd.optimization.units import variable_scale


def search_on(problem: Analytic, **options) -> Search:
    return Search(problem.evaluate, problem.start, problem.lower, problem.upper, **options)


def problem() -> Analytic:
    return Analytic("p", [45.0, 0.5], lambda x: 8 * x[0] + 16 * x[1], lambda x: [x[0] - 50], lower=-90.0, upper=90.0)


def test_scale_is_the_start_or_the_range_where_that_is_tiny():
    scale = variable_scale(
        np.array([45.0, -2.0, 0.0, 0.0]), np.array([-90, -90, -90, -np.inf]), np.array([90, 90, 90, np.inf])
    )
    assert np.array_equal(scale, [45.0, 180.0, 180.0, 1.0])


def test_scaled_numbers_and_gradients():
    search = search_on(problem(), scale=np.array([45.0, 180.0]))
    first = search.begin()
    f = 8 * 45 + 16 * 0.5
    assert first.objective == 1.0
    assert np.allclose(first.objective_gradient, [8 * 45 / f, 16 * 180 / f])
    assert np.allclose(first.constraint_gradients, [[45.0, 0.0]])
    assert np.array_equal(search.physical(search.start), [45.0, 0.5])


def test_nothing_is_evaluated_twice():
    p = problem()
    search = search_on(p, scale=np.array([45.0, 180.0]), eager_gradients=False)
    search.begin()
    y = np.array([0.5, 0.001])
    for _ in range(2):
        search.evaluate(y)
    assert p.batches == [(1, True), (1, False)]
    for _ in range(2):
        search.evaluate(y, gradients=True)
        search.evaluate(y)
    assert p.batches == [(1, True), (1, False), (1, True)]
    assert (search.analyses, search.gradient_evaluations) == (3, 2)


def test_a_failed_design_is_not_simulated_again():
    p = Analytic("p", [1.0], lambda x: x[0], lower=-2, upper=2, fails=lambda x: x[0] < 0)
    search = search_on(p)
    search.begin()
    for gradients in (False, True, True):
        assert search.evaluate(np.array([-1.0]), gradients).status == "the simulation broke down"
    assert search.failures == 1
    assert len(p.batches) == 2


def test_best_is_feasible_first():
    search = search_on(problem())
    search.begin()
    for x in ([51.0, -80.0], [40.0, 0.5], [49.0, 0.5]):
        search.evaluate(np.array(x))
    assert np.array_equal(search.best, [40.0, 0.5])


def test_designs_never_leave_the_bounds_by_rounding():
    p = Analytic("p", [0.1], lambda x: x[0], lower=-0.3, upper=0.7)
    search = search_on(p, scale=np.array([0.1]))
    for bound in (search.lower, search.upper):
        search.evaluate(bound)  # Analytic asserts the bounds
