"""Curvature along ways, and minima distinguished from saddle points, with and without constraints."""

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize
from torchmbd.optimization.curvature import reduced_hessian, tangent_basis
from torchmbd.optimization.kkt import KuhnTucker
from torchmbd.optimization.search import Search


def search_on(problem: Analytic) -> Search:
    return Search(problem.evaluate, problem.start, problem.lower, problem.upper)


def quality(multipliers, bounds) -> KuhnTucker:
    return KuhnTucker(np.array(multipliers, dtype=float), np.array(bounds, dtype=float), 0.0)


def test_ways_are_along_what_has_a_multiplier():
    H = np.diag([-1.0, 2.0, -3.0])
    Z = tangent_basis(np.zeros((0, 3)), quality([], [0, 0, 0]), 1e-3)
    assert Z.shape == (3, 3)
    # pressed against the bound of x3, along the constraint x1 = x2: the curvature is (-1 + 2)/2
    Z = tangent_basis(np.array([[1.0, -1.0, 0.0]]), quality([0.1], [0, 0, 0.5]), 1e-3)
    assert pytest.approx(0.5) == Z.T @ H @ Z
    assert tangent_basis(np.eye(3), quality([1, 1, 1], [0, 0, 0]), 1e-3).shape == (3, 0)


def test_curvature_along_ways_takes_a_design_for_each():
    problem = Analytic("p", [0.7, -0.4, 5.0], lambda x: x[0] ** 3 + x[0] * x[1] ** 2 - 2 * x[2] ** 2, lower=-5, upper=5)
    search = search_on(problem)
    here = search.begin()
    Z = np.linalg.qr(np.array([[1.0, 0.3], [0.5, -1.0], [-0.2, 0.1]]))[0]
    H = np.array([[6 * 0.7, 2 * -0.4, 0], [2 * -0.4, 2 * 0.7, 0], [0, 0, -4]])
    reduced = reduced_hessian(search, search.start, here, np.zeros(0), Z)
    assert reduced is not None
    assert np.allclose(reduced, Z.T @ H @ Z, atol=1e-2)
    assert problem.batches == [(1, True), (2, True)]


METHODS = ["mmfd", "slsqp", "trust-constr", "mma", "ccsaq"]


@pytest.mark.parametrize("method", [*METHODS, "lbfgs"])
def test_a_saddle_on_the_way_is_left(method):
    """From x2 = 0 all gradients stay in the plane of symmetry, whose lowest point is a saddle."""
    problem = Analytic(
        "saddle", [2.0, 0.0], lambda x: x[0] ** 2 + x[1] ** 4 / 4 - x[1] ** 2 / 2 + 1, lower=-3, upper=3, optimum=0.75
    )
    assert optimize(problem, "mmfd", second_order=False).value == pytest.approx(1.0, abs=1e-6)
    result = optimize(problem, method)
    assert result.status == "converged"
    assert result.value == pytest.approx(0.75, abs=1e-5)


@pytest.mark.parametrize("method", [*METHODS, "lbfgs"])
def test_a_maximum_on_a_bound_is_left(method):
    """A ply angle at -90 degrees: stationary by symmetry, on its bound, and the worst there is."""
    f = lambda x: 3 - np.cos(x[0] * np.pi / 90) - np.cos(x[1] * np.pi / 90)  # noqa: E731
    problem = Analytic("angles", [30.0, -90.0], f, lower=-90, upper=90)
    result = optimize(problem, method)
    assert result.status == "converged"
    assert result.value == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_saddle_on_a_curved_constraint_is_left(method):
    """(-1, 0) on the unit circle is stationary, but x2^2 has a negative factor: down is along the circle."""
    problem = Analytic(
        "circle",
        [-0.5, 0.0],
        lambda x: (x[0] + 2.0) ** 2 - 5 * x[1] ** 2 + 0.2 * x[1] ** 4 + 6,
        lambda x: [1 - x[0] ** 2 - x[1] ** 2],
        lower=[-1.5, -1.5],
        upper=[1.5, 1.5],
    )
    flat = optimize(problem, "mmfd", second_order=False)
    result = optimize(problem, method)
    assert result.status == "converged"
    assert result.violation <= 1e-6
    assert result.value < flat.value - 0.1


def test_a_saddle_on_an_equality_is_left():
    """On the unit circle (-1, 0) is the farthest point from (2, 0), the maximum of the objective."""
    circle = lambda x: [x[0] ** 2 + x[1] ** 2 - 1.0]  # noqa: E731
    problem = Analytic("circle", [-1.0, 0.0], lambda x: ((x[0] - 2.0) ** 2 + x[1] ** 2) / 9, circle, lower=-2, upper=2)
    problem.equalities = [0]
    result = optimize(problem, "slsqp")
    assert result.status == "converged"
    assert result.value == pytest.approx(1 / 9, abs=1e-5)


def test_a_search_goes_on_from_a_saddle_where_its_start_is_none():
    """The start is close to the plane of symmetry: a package ends within its tolerance of the saddle."""
    f = lambda x: (x[0] - 1.0) ** 2 + 2.0 - np.cos(2 * x[1])  # noqa: E731  a maximum at 90 degrees
    problem = Analytic("ply", [2.0, np.pi / 2 - 1e-7], f, lower=[-3.0, -np.pi / 2], upper=[3.0, np.pi / 2])
    result = optimize(problem, "slsqp")
    assert result.status == "converged"
    assert result.value == pytest.approx(1.0, abs=1e-4)


def test_many_directions_are_not_measured():
    problem = Analytic("bowl", [1.0] * 25, lambda x: (x**2).sum() + 1, lower=-3, upper=3)
    assert optimize(problem, "slsqp").status == "converged"
    assert max(count for count, _ in problem.batches) == 1


def test_a_minimum_stays():
    problem = Analytic("bowl", [2.0, 1.0], lambda x: x[0] ** 2 + 3 * x[1] ** 2 + 1, lower=-3, upper=3)
    plain, checked = optimize(problem, "mmfd", second_order=False), optimize(problem, "mmfd")
    assert np.array_equal(plain.x, checked.x)
    assert checked.analyses == plain.analyses + 2
