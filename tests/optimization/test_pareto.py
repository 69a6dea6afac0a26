"""Fronts known in closed form, within 1e-3 of each criterion's range; what is simulated together; what is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from tests.optimization.analytic import Analytic, none
from tests.refused import ANY, refused
from torchmbd.optimization import Criteria, pareto_front, sobol
from torchmbd.optimization.pareto import non_dominated


class Several:
    """Criteria f(x) [k] of closed formulas; differentiated as in Analytic, whose constraints they are there."""

    def __init__(self, start, f: Callable, count: int, c: Callable = none, **options) -> None:
        both = lambda x: [*f(x), *c(x)]  # noqa: E731
        self.inner, self.count = Analytic("criteria", start, lambda x: 0 * x[0], both, **options), count
        self.criteria = [f"f{i + 1}" for i in range(count)]
        self.names, self.start = self.inner.names, self.inner.start
        self.lower, self.upper = self.inner.lower, self.inner.upper

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Criteria]:
        return [self._split(e) for e in self.inner.evaluate(X, gradients)]

    def _split(self, e) -> Criteria:
        k = self.count
        if not e.ok:
            return Criteria(np.full(k, np.nan), np.zeros(0), status=e.status)
        dc = e.constraint_gradients
        if dc is None:
            return Criteria(e.constraints[:k], e.constraints[k:])
        return Criteria(e.constraints[:k], e.constraints[k:], dc[:k], dc[k:])


def two_bowls(**changes) -> Several:
    """|x - a|^2 and 100 |x - b|^2: sqrt(f1) + sqrt(f2 / 100) = |a - b| = 5."""
    base = {"lower": -10.0, "upper": 10.0} | changes
    return Several(
        [6.0, -3.0],
        lambda x: [x[0] ** 2 + x[1] ** 2 + 1, 100 * ((x[0] - 3) ** 2 + (x[1] - 4) ** 2) + 1],
        2,
        **base,
    )


def two_bowls_miss(F: np.ndarray) -> np.ndarray:
    return np.sqrt(F[:, 0] - 1) + np.sqrt((F[:, 1] - 1) / 100) - 5


def super_ellipse() -> Several:
    """x1 and x2 inside ((x1 - 20)/20)^8 + (x2 - 1)^8 <= 1: almost a corner, and scales of 1 to 20 (example of the source)."""
    return Several(
        [25.0, 1.3],
        lambda x: [x[0], x[1]],
        2,
        lambda x: [((x[0] - 20) / 20) ** 8 + (x[1] - 1) ** 8 - 1],
        lower=[0, 0],
        upper=[40, 2],
    )


def super_ellipse_miss(F: np.ndarray) -> np.ndarray:
    return F[:, 1] - (1 - (1 - np.minimum(np.abs((F[:, 0] - 20) / 20), 1) ** 8) ** (1 / 8))


def fonseca() -> Several:
    """Fonseca and Fleming's concave front, three variables."""
    r = 1 / np.sqrt(3)
    return Several(
        [1.0, 0.2, -0.6],
        lambda x: [1 - np.exp(-sum((t - r) ** 2 for t in x)), 1 - np.exp(-sum((t + r) ** 2 for t in x))],
        2,
        lower=-4.0,
        upper=4.0,
    )


def fonseca_miss(F: np.ndarray) -> np.ndarray:
    # on the front all variables are t: f1 = 1 - exp(-(sqrt(3) t - 1)^2), f2 the same with + 1
    t = 1 - np.sqrt(-np.log(1 - F[:, 0]))
    return F[:, 1] - (1 - np.exp(-((t + 1) ** 2)))


def zdt2() -> Several:
    """Zitzler, Deb and Thiele's second, five variables: f2 = 1 - f1^2."""

    def f(x: Sequence):
        g = 1 + 9 * sum(t**2 for t in x[1:]) / (len(x) - 1)
        return [x[0], g * (1 - (x[0] / g) ** 2)]

    return Several([0.6, 0.5, 0.3, 0.4, 0.2], f, 2, lower=0.0, upper=1.0)


CENTERS = np.array([[1.0, 0, 0], [0, 2, 0], [0.5, 0, 3]])


def three_bowls() -> Several:
    """Distances squared from three centers: the front is the triangle between them."""
    return Several(
        [4.0, -3.0, -2.0], lambda x: [sum((x - center) ** 2) for center in CENTERS], 3, lower=-5.0, upper=5.0
    )


FRONTS = {
    "two bowls": (two_bowls, two_bowls_miss),
    "super-ellipse": (super_ellipse, super_ellipse_miss),
    "fonseca": (fonseca, fonseca_miss),
    "zdt2": (zdt2, lambda F: F[:, 1] - (1 - F[:, 0] ** 2)),
}
RANGES = {"two bowls": [25.0, 2500.0], "fonseca": [0.9817, 0.9817], "zdt2": [1.0, 1.0]}


@pytest.mark.thorough
@pytest.mark.parametrize("name", FRONTS)
def test_known_front(name):
    make, miss = FRONTS[name]
    front = pareto_front(make(), divisions=12)
    F, ranges = front.criteria, front.nadir - front.utopia
    if name in RANGES:  # where the front is a corner, its ends are steeper than the anchors' small second weight
        assert np.allclose(ranges, RANGES[name], rtol=3e-3)
    assert np.abs(miss(F)).max() <= 1e-3
    assert len(F) == 13
    assert np.all(np.diff(F[:, 0]) > 0)
    assert np.all(np.diff(F[:, 1]) < 0)
    # even: no gap is twice the mean along the front, in normalized criteria
    steps = np.linalg.norm(np.diff(F / ranges, axis=0), axis=1)
    assert steps.max() <= 2.0 * steps.mean()


def test_every_search_is_heard_of_at_its_end():
    results = []
    front = pareto_front(two_bowls(), divisions=4, ended=results.append)
    assert len(results) >= 5  # two anchors and three points, some of them again
    assert {id(point.result) for point in front.points} <= {id(result) for result in results}


@pytest.mark.thorough
def test_three_criteria():
    front = pareto_front(three_bowls(), divisions=6)
    X = np.array([point.x for point in front.points])
    shares = np.linalg.solve(
        np.vstack([CENTERS.T, np.ones(3)])[[0, 1, 3]], np.column_stack([X[:, :2], np.ones(len(X))]).T
    )
    assert shares.min() >= -1e-3
    # in the plane of the triangle; the criteria miss the front by the square of this distance
    assert np.allclose(CENTERS.T @ shares, X.T, atol=1e-2)
    assert len(X) >= 22  # of C(8, 2) = 28: the normals of some points on the rim miss the front
    assert (shares > 0.05).all(axis=0).sum() >= 15


@pytest.mark.thorough
def test_a_gap_of_the_front_is_jumped():
    """f2 oscillates along f1: the front falls into pieces, and what lies behind the gaps is dropped."""
    problem = Several([0.3], lambda x: [x[0], 1 - x[0] - 0.25 * np.sin(4 * np.pi * x[0])], 2, lower=0.0, upper=1.0)
    front = pareto_front(problem, divisions=20, starts=sobol(6, seed=1))
    F = front.criteria
    dense = np.linspace(0, 1, 4001)
    curve = np.column_stack([dense, 1 - dense - 0.25 * np.sin(4 * np.pi * dense)])
    true = curve[curve[:, 1] <= np.minimum.accumulate(curve[:, 1])]
    distance = np.array([np.abs(true - f).max(axis=1).min() for f in F])
    assert distance.max() <= 1e-3
    assert front.dropped > 0
    assert np.diff(true[:, 0]).max() > 0.2  # there is a gap indeed


def test_weights_are_exchange_rates():
    """Where f2 = 1 - f1^2 the slope is -2 f1: so much of f2 is one of f1 worth."""
    front = pareto_front(zdt2(), divisions=8)
    for point in front.points[1:-1]:
        assert point.weights.sum() == pytest.approx(1.0)
        assert point.weights[0] / point.weights[1] == pytest.approx(2 * point.criteria[0], rel=1e-2)


@pytest.mark.thorough
def test_points_of_a_wave_are_one_batch_and_warm():
    problem = two_bowls()
    front = pareto_front(problem, divisions=16)
    lanes = [count for count, _ in problem.inner.batches]
    assert front.analyses == sum(lanes) == problem.inner.functions
    assert front.batches == len(lanes)
    assert max(lanes) == 8  # the last of the waves 1, 2, 4, 8
    assert len(lanes) < 0.5 * sum(lanes)
    assert all(point.result.converged for point in front.points)


def test_an_end_is_the_best_of_all_designs_with_the_minimum_of_its_criterion():
    """The first criterion does not depend on x1 and x2, on which the second does, however small it is at the other end."""

    def f(x: Sequence):
        return [3.0 + x[2], 1e-3 * (1 + (x[0] - 0.3) ** 2 + 2 * (x[1] + 0.4 + 0.1 * x[2]) ** 2) / x[2]]

    for method in ("mmfd", "slsqp"):
        problem = Several([0.9, 0.8, 0.5], f, 2, lower=[-1.0, -1.0, 0.1], upper=[1.0, 1.0, 1.0])
        front = pareto_front(problem, divisions=2, method=method)
        assert np.allclose(front.points[0].criteria, [3.1, 1e-2], rtol=1e-5)
        assert np.allclose(front.points[-1].criteria, [4.0, 1e-3], rtol=1e-5)


@pytest.mark.thorough
def test_a_constant_part_of_a_criterion_leaves_the_front():
    """Units of criteria come from what the variables change."""
    shifted = two_bowls()
    inner, constants = shifted.evaluate, np.array([1e8, -1e8])
    shifted.evaluate = lambda X, gradients: [
        dataclasses.replace(criteria, values=criteria.values + constants) for criteria in inner(X, gradients)
    ]
    front, other = pareto_front(two_bowls(), divisions=4), pareto_front(shifted, divisions=4)
    assert len(front.points) == len(other.points) == 5
    assert np.allclose(front.criteria, other.criteria - constants, atol=2e-3 * (front.nadir - front.utopia))


@pytest.mark.thorough
def test_one_design_that_is_best_for_all():
    problem = Several(
        [3.0, 1.0], lambda x: [x[0] ** 2 + x[1] ** 2, 2 * x[0] ** 2 + x[1] ** 2], 2, lower=-5.0, upper=5.0
    )
    front = pareto_front(problem)
    assert len(front.points) == 1
    assert np.allclose(front.points[0].x, 0.0, atol=1e-3)


def test_failed_designs_are_passed():
    front = pareto_front(two_bowls(fails=lambda x: bool(x[0] + x[1] > 11)), divisions=6)
    assert np.abs(two_bowls_miss(front.criteria)).max() <= 5e-3
    assert len(front.points) >= 6


@pytest.mark.thorough
def test_interruption_returns_the_points_so_far():
    problem, whole = two_bowls(), pareto_front(two_bowls(), divisions=16)
    inner, calls = problem.evaluate, []

    def evaluate(X, gradients):
        calls.append(len(X))
        if len(calls) > 0.7 * whole.batches:
            raise KeyboardInterrupt
        return inner(X, gradients)

    problem.evaluate = evaluate
    front = pareto_front(problem, divisions=16)
    assert front.interrupted
    assert 2 <= len(front.points) < len(whole.points)
    assert np.abs(two_bowls_miss(front.criteria)).max() <= 1e-2


def test_dominated_rows():
    F = np.array([[1.0, 5], [2, 3], [2, 4], [3, 3], [4, 1], [0.5, 9], [4, 1]])
    assert non_dominated(F) in ([5, 0, 1, 4], [5, 0, 1, 6])


def test_what_it_refuses():
    with refused("problem"):
        pareto_front(Several([1.0], lambda x: [x[0]], 1, lower=0.0, upper=2.0))
    with refused("starts"):
        pareto_front(two_bowls(fails=lambda x: True))
    nowhere = Several([1.0], lambda x: [x[0], -x[0]], 2, lambda x: [x[0] + 1, 1 - x[0]], lower=-3.0, upper=2.0)
    with refused("minimize.f1"):
        pareto_front(nowhere)
    wrong = two_bowls()
    wrong.criteria = ["f1", "f2", "f3"]
    with refused("problem.evaluate", ANY, "(2,)", "(3,)", "f1, f2, f3"):
        pareto_front(wrong)


def test_points_are_searched_from_everywhere_where_asked():
    """A front with a local one beside it: x1 alone decides between them, and its valley beside the anchors is the wrong one."""
    dent = lambda t: np.exp(-((t / 0.3) ** 2))  # noqa: E731

    def f(x):
        lift = 0.5 + 0.02 * (x[0] - 1.0) ** 2 - 0.5 * dent(x[0] + 2.0) * (4 * x[1] * (1 - x[1])) ** 2
        return [x[1] + lift, 1 - x[1] + lift]

    problem = lambda: Several([1.0, 0.5], f, 2, lower=[-3.0, 0.0], upper=[3.0, 1.0])  # noqa: E731
    starts = [[1.0, 0.5], [-2.05, 0.5]]
    near = pareto_front(problem(), 4, starts=starts[:1])
    wide = pareto_front(problem(), 4, starts=starts, everywhere=True)
    middle = lambda front: min(point.criteria.sum() for point in front.points)  # noqa: E731
    assert middle(near) == pytest.approx(2.0, abs=1e-3)
    assert middle(wide) < 1.4
