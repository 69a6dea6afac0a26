"""Curvature along ways, and minima distinguished from saddle points, with and without constraints."""

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import Evaluation, optimize
from torchmbd.optimization.curvature import reduced_hessian, tangent_basis
from torchmbd.optimization.kkt import KuhnTucker
from torchmbd.optimization.search import Search


def search_on(problem: Analytic) -> Search:
    return Search(problem.evaluate, problem.start, problem.lower, problem.upper)


def basis(gradients, multipliers, bounds, equality=None) -> np.ndarray:
    gradients = np.array(gradients, dtype=float).reshape(-1, len(bounds))
    evaluation = Evaluation(0.0, np.zeros(len(gradients)), np.zeros(len(bounds)), gradients)
    quality = KuhnTucker(np.array(multipliers, dtype=float), np.array(bounds, dtype=float), 0.0)
    return tangent_basis(
        evaluation, quality, 1e-3, np.zeros(len(gradients), bool) if equality is None else np.array(equality)
    )


def test_ways_are_along_what_has_a_multiplier():
    H = np.diag([-1.0, 2.0, -3.0])
    assert basis([], [], [0, 0, 0]).shape == (3, 3)
    # pressed against the bound of x3, along the constraint x1 = x2: the curvature is (-1 + 2)/2
    Z = basis([1.0, -1.0, 0.0], [0.1], [0, 0, 0.5])
    assert pytest.approx(0.5) == Z.T @ H @ Z
    assert basis(np.eye(3), [1, 1, 1], [0, 0, 0]).shape == (3, 0)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_ways_do_not_depend_on_the_unit_of_a_constraint(unit):
    assert basis([[unit, 0.0]], [0.2 / unit], [0, 0]).shape == (2, 1)
    assert basis([[unit, 0.0]], [2e-4 / unit], [0, 0]).shape == (2, 2)


def test_ways_are_along_equalities():
    assert basis([[1.0, 0.0]], [0.0], [0, 0], [True]).shape == (2, 1)


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


METHODS = ["mmfd", "sqcqp", "slsqp", "trust-constr", "mma", "ccsaq"]


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


PACKAGES = ["sqcqp", "slsqp", "trust-constr", "mma", "lbfgs"]


@pytest.mark.parametrize("method", PACKAGES)
def test_a_start_that_is_a_saddle(method):
    """The design beside the start that is tried first goes up."""
    f = lambda x: 10 * x[0] ** 2 - x[1] ** 2 + 0.1 * x[1] ** 4 + 5  # noqa: E731
    result = optimize(Analytic("saddle", [0.0, 0.0], f, lower=-3, upper=3), method)
    assert result.status == "converged"
    assert result.value == pytest.approx(2.5, abs=1e-5)


@pytest.mark.parametrize("method", ["slsqp", "mma"])
def test_several_plies_across(method):
    """Six angles at maxima of different heights: none is left there."""
    f = lambda x: 40 + sum((6 - k) * np.cos(2 * x[k]) for k in range(6)) + x[6] ** 2  # noqa: E731
    result = optimize(Analytic("plies", [0.0] * 6 + [1.0], f, lower=-1.4, upper=1.4), method)
    assert result.status == "converged"
    assert result.value == pytest.approx(40 + 21 * np.cos(2.8), rel=1e-5)


def test_a_saddle_between_equal_sides_is_left_once():
    """Nothing better lies on the line of an equality: the search does not try the same way again."""
    f = lambda x: x[1] ** 2 - (x[0] - 1) ** 2 + 2  # noqa: E731
    problem = Analytic("line", [1.5, 0.7], f, lambda x: [x[0] - 1.0], lower=-3, upper=3)
    problem.equalities = [0]
    result = optimize(problem, "slsqp")
    assert result.status == "converged"
    assert result.value == pytest.approx(2.0, abs=1e-6)
    assert len({iterate.x.tobytes() for iterate in result.history}) == len(result.history)


def test_a_saddle_beyond_which_nothing_is_better_is_told():
    """Along x2 the Lagrangian falls, but all designs that are better and feasible fail."""
    f, c = lambda x: x[0] - x[1] ** 2 + 3, lambda x: [1 - x[0] + 0.5 * x[1] ** 2]
    problem = Analytic("walls", [0.5, 0.0], f, c, lower=-3, upper=3, fails=lambda x: x[0] > 1.0 + 1e-5)
    result = optimize(problem, "slsqp")
    assert result.value == pytest.approx(4.0, abs=1e-4)
    assert "beyond this saddle point nothing better was found" in result.message


def test_a_failing_design_beside_the_end_is_told():
    f = lambda x: (x[0] - 1) ** 2 + x[1] ** 2 + 1  # noqa: E731
    problem = Analytic("edge", [2.0, 0.0], f, lower=-3, upper=3, fails=lambda x: 0.0 < abs(x[1]) < 0.1)
    result = optimize(problem, "slsqp")
    assert result.value == pytest.approx(1.0, abs=1e-6)
    assert "a design beside it fails" in result.message


@pytest.mark.parametrize("method", PACKAGES[:3])
def test_a_corner_of_a_steep_constraint_stays(method):
    """Along x1 the objective falls, and curves down, but a constraint with a small multiplier and a large slope ends it."""
    f = lambda x: x[1] ** 2 - x[0] ** 2 - 1e-9 * x[0] + 3  # noqa: E731
    c = lambda x: [1e4 * (x[0] - 1), -x[0] - 0.5]  # noqa: E731
    problem = Analytic("corner", [0.5, 0.7], f, c, lower=-3, upper=3)
    result = optimize(problem, method)
    assert result.status == "converged"
    assert result.value == pytest.approx(2.0, abs=1e-5)
    assert "saddle" not in result.message


def test_a_curvature_that_is_not_measured_is_told():
    problem = Analytic("bowl", [1.0] * 25, lambda x: (x**2).sum() + 1, lower=-3, upper=3)
    result = optimize(problem, "slsqp")
    assert result.status == "converged"
    assert max(count for count, _ in problem.batches) == 1
    assert "25 free directions" in result.message


def test_a_limit_inside_the_measurement_does_not_undo_the_end():
    f = lambda x: ((x - 0.3) ** 2).sum() + 1  # noqa: E731
    whole = optimize(Analytic("bowl", [1.0, 2.0], f, lower=-3, upper=3), "slsqp")
    cut = optimize(Analytic("bowl", [1.0, 2.0], f, lower=-3, upper=3), "slsqp", max_analyses=whole.analyses - 1)
    assert cut.status == "converged"
    assert "before the curvature was measured" in cut.message


def test_a_minimum_stays():
    problem = Analytic("bowl", [2.0, 1.0], lambda x: x[0] ** 2 + 3 * x[1] ** 2 + 1, lower=-3, upper=3)
    plain, checked = optimize(problem, "mmfd", second_order=False), optimize(problem, "mmfd")
    assert np.array_equal(plain.x, checked.x)
    assert checked.analyses == plain.analyses + 2
