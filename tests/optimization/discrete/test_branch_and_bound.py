"""Discrete optima against exhaustive enumeration, and what a certificate says."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.optimization.analytic import Analytic
from tests.optimization.structures import three_bar_truss
from tests.refused import refused
from torchmbd.optimization import optimize_discrete, sobol
from torchmbd.optimization.discrete.grid import Grid


def valley(**changes) -> Analytic:
    """A narrow valley across the grid: the nearest value of each variable is far up its side."""
    base = {"lower": -6.0, "upper": 6.0} | changes

    def f(x):
        return (
            50 * (x[0] + 0.7 * x[1] - 1.3 * x[2] - 0.45) ** 2 + 0.6 * (x[0] - 2.37) ** 2 + 0.3 * (x[1] + 1.61) ** 2 + 1
        )

    return Analytic("valley", [0.5, 0.5, 0.5], f, **base)


def angles() -> Analytic:
    """Four ply angles [deg]: a cosine series with several minima, coupled, and a limit on one combination."""

    def t(x, k):
        return np.cos(k * np.pi / 180 * x)

    def f(x):
        first = sum((4 - i) * (1.5 - t(x[i] - 13 * i, 2) - 0.45 * t(x[i] + 20, 4)) for i in range(4))
        return first + 1.2 * t(x[0] - x[1], 2) + 0.8 * t(x[2] + x[3] - 11, 2) + 6

    c = lambda x: [0.35 - t(x[0] - x[3] - 30, 1) ** 2]  # noqa: E731
    problem = Analytic("angles", [45.0, -45, 45, -45], f, c, lower=-90.0, upper=90.0)
    problem.period = np.full(4, 180.0)
    return problem


def enumerated(problem: Analytic, values: list[np.ndarray]) -> float:
    """Return the value of the best feasible design of all."""
    X = np.array(list(product(*values)))
    with np.errstate(all="ignore"):
        F, C = np.asarray(problem.f(list(X.T))), problem.c(list(X.T))
    feasible = np.all([row <= 1e-6 for row in C], axis=0) if len(C) else np.ones(len(X), dtype=bool)
    return float(F[feasible].min())


CASES: dict[str, tuple[Callable[[], Analytic], float | list, int, float]] = {
    "valley": (valley, 1.0, 1, 0.2),
    "valley, fine": (valley, 0.25, 1, 0.003),
    "angles by 15 degrees": (angles, 15.0, 16, 0.05),
    "angles by 5 degrees": (angles, 5.0, 16, 0.001),
    "0, 45, -45, 90 degrees": (angles, [[-45.0, 0.0, 45.0, 90.0]] * 4, 16, np.inf),
    "areas from a list": (three_bar_truss, [[0.1, 0.2, 0.3, 0.5, 0.8, 1.0, 1.2]] * 2, 1, np.inf),
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_equals_exhaustive_enumeration(case):
    make, allowed, starts, share = CASES[case]
    problem = make()
    result = optimize_discrete(problem, allowed, starts=sobol(starts, seed=3, include_initial=True))
    value = enumerated(problem, Grid(problem, allowed, problem.lower, problem.upper, None).values)
    assert result.status == "converged"
    assert result.best.value == pytest.approx(value, rel=1e-9)
    assert result.best.violation <= 1e-6
    assert result.certificate.holds
    assert result.analyses == sum(count for count, _ in problem.batches)
    assert result.analyses <= share * result.size


RULES = {"balanced": {"balanced": True}, "45 degrees between neighbors": {"max_step": 45.0}}


@pytest.mark.extensions
@pytest.mark.thorough
@pytest.mark.parametrize("name", RULES)
def test_rules_of_a_laminate_are_kept(name):
    """The best of all stacks that keep the rules, by enumeration."""
    problem, rules = angles(), mbd.lamination.LaminationRules(**RULES[name])
    result = optimize_discrete(problem, 15.0, starts=sobol(16, seed=3, include_initial=True), admits=rules.admits)
    X = np.array([x for x in product(np.arange(-90.0, 91.0, 15.0), repeat=4) if rules.admits(x)])
    F, C = np.asarray(problem.f(list(X.T))), problem.c(list(X.T))[0]
    assert result.best.value == pytest.approx(F[C <= 1e-6].min(), rel=1e-9)
    assert result.certificate.holds
    assert all(rules.admits(candidate.x) for candidate in result.candidates)


@pytest.mark.thorough
def test_rules_that_no_design_keeps():
    result = optimize_discrete(valley(), 1.0, admits=lambda x: False)
    assert result.status == "failed"
    assert "no design on the allowed values" in result.message


@pytest.mark.thorough
def test_plain_rounding_is_worse_in_a_valley():
    result = optimize_discrete(valley(), 1.0)
    assert result.rounded.value > 1.5 * result.best.value
    assert result.relaxed.best.value == pytest.approx(1.0, abs=1e-6)
    assert result.candidates[0] == result.best
    values = [c.value for c in result.candidates]
    assert values == sorted(values)


@pytest.mark.thorough
def test_the_certificate_counts_all_neighbors():
    result = optimize_discrete(valley(), 0.5)
    assert result.certificate.neighbors == 5**3 - 1
    assert result.certificate.which == "every variable up to 2 increments away"
    assert result.certificate.closest.value > result.best.value
    inside = [c for c in result.candidates if np.all(np.abs(c.x - result.best.x) <= 1.0 + 1e-9)]
    assert len(inside) == 5**3
    fewer = optimize_discrete(valley(), 0.5, max_neighbors=100)
    assert fewer.certificate.neighbors == 6 * 2 + 12  # one variable by 1 or 2, two variables by 1
    assert fewer.certificate.which == "up to 2 increments away in all"


def test_without_boxes_the_descent_over_neighbors_remains():
    result = optimize_discrete(valley(), 1.0, max_boxes=0)
    assert result.boxes == 0
    assert result.certificate.holds
    assert result.best.value < result.rounded.value
    assert result.status == "max_boxes"


@pytest.mark.thorough
@pytest.mark.parametrize("limit", [1, 10, 1000, *(pytest.param(x, marks=pytest.mark.slow) for x in (2, 5, 20))])
def test_a_search_cut_off_by_its_limit_of_boxes_says_so(limit):
    """And never "converged" while a box is left that may hold something better; with room enough the result is exact."""
    problem = angles()
    starts = sobol(16, seed=3, include_initial=True)
    whole = optimize_discrete(problem, 15.0, starts=starts)
    cut = optimize_discrete(problem, 15.0, starts=starts, max_boxes=limit, max_lanes=1)
    assert whole.status == "converged"
    assert cut.boxes <= limit
    assert cut.status == ("converged" if cut.boxes < limit or limit == 1000 else "max_boxes")
    assert ("boxes were left" in cut.message) == (cut.status == "max_boxes")
    assert cut.best.value >= whole.best.value * (1.0 - 1e-9)


@pytest.mark.parametrize("iterations", [1, 2, 4, 8])
@pytest.mark.parametrize("allowed", [1.0, [1.0, 1.0, [-6.0, 0.0, 5.0]]])
def test_a_search_that_has_not_converged_bounds_no_box(iterations, allowed):
    """A value where a limit of iterations ended is above what its box holds: the result is exact, or is not "converged"."""
    problem = valley()
    result = optimize_discrete(problem, allowed, max_iterations=iterations)
    value = enumerated(problem, Grid(problem, allowed, problem.lower, problem.upper, None).values)
    assert result.boxes > 0
    assert result.status == "converged"
    assert result.best.value == pytest.approx(value, rel=1e-9)


def wall(fails: Callable[[np.ndarray], bool]) -> Analytic:
    """A convex problem whose designs fail in a part of the domain."""
    f = lambda x: 50 * (x[0] + 0.1 * x[1] - 0.6) ** 2 + 0.01 * x[1] ** 2  # noqa: E731
    return Analytic("wall", [0.5, 0.5], f, lower=-8.0, upper=8.0, fails=fails)


@pytest.mark.parametrize(
    "first", [0.9, 0.3, -9.0]
)  # x1 of the failing designs from here: a box, more, the start as well
def test_a_box_whose_start_fails_is_searched_from_elsewhere(first):
    problem = wall(lambda x: bool(first < x[0] < 1.3 and abs(x[1]) < 3))
    result = optimize_discrete(problem, 1.0)
    values = np.arange(-8.0, 9.0)
    known = [(problem.f(x), x) for x in product(values, values) if not problem.fails(x)]
    assert result.best.value == pytest.approx(min(known)[0], rel=1e-9)


def test_boxes_that_cannot_be_searched_are_counted():
    """A box whose designs fail for all but one continuous choice stays unknown, so the search has not converged."""
    problem = wall(lambda x: bool(x[0] > 0.9 and abs(x[1] - 4.0) > 1e-9))
    result = optimize_discrete(problem, [1.0, None])
    assert result.status == "stalled"
    assert "boxes did not converge, or their starts failed" in result.message


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_nearest_admitted_design_is_that_in_increments(unit):
    """In other units of a variable it is the same design."""
    box = SimpleNamespace(names=["angle", "thickness"])
    even = lambda x: round(x[0] / 0.1 + x[1] / unit) % 2 == 0  # noqa: E731
    grid = Grid(box, [0.1, unit], np.array([-1.0, 0.0]), np.array([1.0, 10 * unit]), None, even)
    x = grid.nearest_admitted(np.array([0.13, 4.0 * unit]), 2, 1000)
    assert x == pytest.approx([0.2, 4.0 * unit])


def test_the_nearest_admitted_angle_may_lie_across_the_ends():
    box = SimpleNamespace(names=["angle"])
    grid = Grid(box, 10.0, np.array([-90.0]), np.array([90.0]), np.array([180.0]), lambda x: x[0] in (-80.0, 70.0))
    assert grid.nearest_admitted(np.array([88.0]), 2, 100) == pytest.approx([-80.0])


@pytest.mark.thorough
def test_continuous_variables_stay_continuous():
    problem = valley()
    result = optimize_discrete(problem, [1.0, None, 1.0])
    x = result.best.x
    assert x[0] == round(x[0])
    assert x[2] == round(x[2])
    # x2 is optimal for these: d f / d x2 = 0
    slope = problem.evaluate(x[None], True)[0].objective_gradient[1]
    assert abs(slope) <= 0.05
    assert result.best.value < optimize_discrete(valley(), 1.0).best.value
    assert result.certificate.neighbors == 24


def waves(slope: float = -0.2) -> Analytic:
    """A minimum near each even number, the lower the farther along the slope."""
    return Analytic("waves", [0.1], lambda x: 2 - np.cos(np.pi * x[0]) + slope * x[0], lower=-2.0, upper=4.0)


@pytest.mark.parametrize("slope", [-0.2, 0.2, -1.5])
@pytest.mark.parametrize("allowed", [1.0, [1.0, None], [[-2.0, 0.0, 1.0, 2.0, 3.0], None]])
@pytest.mark.parametrize("boxes", [0, 1000])
def test_a_worst_case_is_that_of_each_design(slope, allowed, boxes):
    """The extra variable is no choice: neighbors are compared by their own worst cases, and so are their values."""
    robust = mbd.optimization.RobustProblem(waves(slope), 0.05, "worst")
    result = optimize_discrete(robust, allowed, max_boxes=boxes)
    values = Grid(robust, allowed, robust.lower, robust.upper, None).values[0]
    worst = {x: max(waves(slope).f([x + d]) for d in (-0.05, 0.05)) for x in values.tolist()}
    assert all(c.value == pytest.approx(worst[c.x[0]], rel=1e-12) for c in result.candidates)
    assert all(c.violation <= 1e-12 for c in result.candidates)
    assert len({c.x[0] for c in result.candidates}) == len(result.candidates)
    near = [worst[x] for x in values.tolist() if 0.0 < abs(x - result.best.x[0]) <= 2.0]
    assert result.best.value < min(near)
    assert result.certificate.closest.value >= min(near)
    if boxes:
        assert result.best.value == pytest.approx(min(worst.values()), rel=1e-12)
        assert result.status == "converged"


def test_the_extra_variable_takes_no_increments():
    with refused("allowed.beta", 1.0):
        optimize_discrete(mbd.optimization.RobustProblem(waves(), 0.05, "worst"), [1.0, 1.0])


def test_angles_are_neighbors_across_their_ends():
    problem = Analytic("angle", [60.0], lambda x: 2 - np.cos(2 * np.pi / 180 * (x[0] - 83)), lower=-90, upper=90)
    problem.period = [180.0]
    result = optimize_discrete(problem, 10.0)
    assert result.best.x[0] == 80.0
    assert {60.0, 70.0, -80.0} < {c.x[0] for c in result.candidates}
    assert result.certificate.neighbors == 4


def test_an_increment_may_be_a_tensor():
    """As `mbd.deg(5)` is."""
    problem = valley()
    one, other = (Grid(problem, x, problem.lower, problem.upper, None).values for x in (2.0, torch.tensor(2.0)))
    assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_values_inside_the_bounds_only():
    problem = Analytic("p", [0.7, 0.7], lambda x: (x[0] - 0.1) ** 2 + (x[1] - 0.93) ** 2, lower=0.1, upper=0.95)
    result = optimize_discrete(problem, 0.25)
    assert np.array_equal(result.best.x, [0.25, 0.75])
    assert result.size == 9


def test_no_feasible_design_on_the_values():
    problem = Analytic(
        "p", [0.7, 0.2], lambda x: x[0] + x[1], lambda x: [0.6 - x[0], x[0] - 0.9], lower=-2.0, upper=2.0
    )
    result = optimize_discrete(problem, 1.0)
    assert result.status == "infeasible"
    assert result.best.x[0] == 1.0
    assert result.best.violation == pytest.approx(0.1)


@pytest.mark.thorough
def test_failing_neighbors_are_counted():
    result = optimize_discrete(valley(fails=lambda x: bool(x[0] > 3.9)), 1.0)  # the optimum is at x1 = 3
    assert result.best.x[0] == 3.0
    assert result.status == "stalled"
    assert not result.certificate.holds
    assert result.certificate.failed == 2 * 25
    assert "50 of 124 neighbors" in result.message
    assert optimize_discrete(valley(fails=lambda x: True), 1.0).status == "failed"


def test_interruption_keeps_the_best():
    problem = valley()
    inner, calls = problem.evaluate, []

    def evaluate(X, gradients):
        calls.append(len(X))
        if len(calls) == 25:
            raise KeyboardInterrupt
        return inner(X, gradients)

    problem.evaluate = evaluate
    result = optimize_discrete(problem, 1.0)
    assert result.status == "interrupted"
    assert result.best is not None


def test_what_it_refuses():
    with refused("allowed"):
        optimize_discrete(valley(), [1.0, 1.0])
    with refused("allowed"):
        optimize_discrete(valley(), None)
    with refused("allowed.x2"):
        optimize_discrete(valley(), [1.0, [7.0, 8.0], 1.0])
    with refused("allowed.x1", -1.0):
        optimize_discrete(valley(), -1.0)
