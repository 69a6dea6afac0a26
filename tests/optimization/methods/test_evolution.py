"""Differential evolution: known optima without gradients, one batch per generation, failures, and what it refuses."""

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from tests.optimization.structures import three_bar_truss
from tests.refused import ANY, refused
from torchmbd.optimization import Evaluation, optimize
from torchmbd.optimization.multistart import multistart

METHOD = "differential_evolution"


def rastrigin(**changes) -> Analytic:
    """Ten by ten minima between -5 and 5; the best one, 1, at the origin."""
    base = {"lower": -5.12, "upper": 5.12} | changes
    return Analytic("rastrigin", [3.1, -4.2], lambda x: 21 + sum(t**2 - 10 * np.cos(2 * np.pi * t) for t in x), **base)


@pytest.mark.thorough
def test_finds_the_best_of_many_minima_where_a_local_search_does_not():
    problem = rastrigin()
    result = optimize(problem, METHOD, max_iterations=300)
    assert result.status == "converged"
    assert result.value == pytest.approx(1.0, abs=1e-5)
    assert np.allclose(result.x, 0.0, atol=1e-4)
    assert optimize(rastrigin()).value > 1.5


def test_a_generation_is_one_batch_without_gradients():
    problem = rastrigin()
    result = optimize(problem, METHOD, max_iterations=5, population=8)
    # the start, the first generation but for the start, five generations; at the end gradients for the residual
    assert [count for count, _ in problem.batches] == [1, 15, 16, 16, 16, 16, 16, 1]
    assert [gradients for _, gradients in problem.batches] == [False] * 7 + [True]
    assert result.status == "max_iterations"
    assert result.analyses == sum(count for count, _ in problem.batches)
    assert result.gradient_evaluations == 1
    objectives = [iterate.objective for iterate in result.history]
    assert objectives == sorted(objectives, reverse=True)


@pytest.mark.thorough
def test_constraints_hold():
    problem = three_bar_truss()
    result = optimize(problem, METHOD, max_iterations=300)
    assert result.status == "converged"
    assert result.violation <= 1e-6
    assert result.value == pytest.approx(problem.optimum, rel=1e-3)


@pytest.mark.thorough
def test_contradictory_constraints_are_named():
    problem = Analytic("p", [3.0], lambda x: x[0], lambda x: [x[0] + 1, 1 - x[0]], lower=-5, upper=5)
    result = optimize(problem, METHOD, max_iterations=50)
    assert result.status == "infeasible"
    assert "[0, 1]" in result.message


@pytest.mark.thorough
def test_failures_are_the_worst_of_their_generation():
    problem = rastrigin(fails=lambda x: bool(x[0] < 0.5))
    result = optimize(problem, METHOD, max_iterations=300)
    assert result.status == "converged"
    assert result.failures > 0
    assert result.x[0] == pytest.approx(1.0, abs=0.02)
    assert result.value == pytest.approx(2.0, abs=0.01)


def test_a_failing_start_and_a_fixed_variable():
    assert optimize(rastrigin(fails=lambda x: True), METHOD).status == "failed"
    result = optimize(rastrigin(lower=[-5, -4.2], upper=[5, -4.2]), METHOD, max_iterations=200)
    assert result.x[1] == -4.2
    assert result.x[0] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.thorough
def test_the_same_seed_is_the_same_run_also_among_others():
    alone = optimize(rastrigin(), METHOD, max_iterations=20, seed=3)
    problem = rastrigin()
    study = multistart(problem, METHOD, [[3.1, -4.2], [1.0, 1.0]], max_iterations=20, seed=3)
    assert np.array_equal(study.results[0].x, alone.x)
    assert problem.batches[1][0] == 2 * 29
    assert optimize(rastrigin(), METHOD, max_iterations=20, seed=4).value != alone.value


def test_limit_of_analyses_and_interruption():
    assert optimize(rastrigin(), METHOD, max_analyses=50).analyses == 50
    problem, inner = rastrigin(), rastrigin().evaluate

    def evaluate(X, gradients):
        if len(X) == 30:
            raise KeyboardInterrupt
        return inner(X, gradients)

    problem.evaluate = evaluate
    assert optimize(problem, METHOD).status == "interrupted"


def test_limit_of_analyses_and_interruption_at_the_last_gradient():
    """The gradient at the end, for the multipliers alone, is one analysis more."""
    whole = optimize(rastrigin(), METHOD, max_iterations=1)
    limited = optimize(rastrigin(), METHOD, max_iterations=1, max_analyses=whole.analyses - 1)
    assert limited.analyses == whole.analyses - 1
    assert (limited.value, limited.status, limited.message) == (whole.value, whole.status, whole.message)
    assert np.isfinite(whole.kkt_residual)
    assert np.isnan(limited.kkt_residual)
    problem, inner = rastrigin(), rastrigin().evaluate

    def evaluate(X, gradients):
        if gradients:
            raise KeyboardInterrupt
        return inner(X, gradients)

    problem.evaluate = evaluate
    alone = optimize(problem, METHOD, max_iterations=1)
    assert (alone.status, alone.value) == ("interrupted", whole.value)
    study = multistart(problem, METHOD, max_iterations=1)
    assert study.interrupted
    assert [result.status for result in study.results] == ["interrupted"]


def test_what_it_refuses():
    with refused("bounds"):
        optimize(rastrigin(upper=[np.inf, 5]), METHOD)
    with refused("population", 1):
        optimize(rastrigin(), METHOD, population=1)
    problem = rastrigin()
    problem.equalities = [0]
    with refused("method"):
        optimize(problem, METHOD)


def test_errors_of_the_problem_come_out():
    problem = rastrigin()
    problem.evaluate = lambda X, gradients: [Evaluation(1.0, np.zeros(0))] * (len(X) - (len(X) > 1))
    with refused("problem.evaluate", ANY, "28 evaluations"):
        optimize(problem, METHOD)
