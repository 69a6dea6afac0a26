"""Robust design against closed forms and sampling: means, worst cases, optima, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from tests.refused import refused
from torchmbd.optimization import RobustProblem, optimize
from torchmbd.optimization.multistart import multistart


def bowl() -> Analytic:
    """Coupled, of degree five in x1."""
    return Analytic(
        "bowl",
        [1.5, -2.0],
        lambda x: x[0] ** 4 + 0.3 * x[0] ** 5 + 2 * x[1] ** 2 + x[0] * x[1] + 9,
        lambda x: [x[0] + 2 * x[1] - 3, x[0] ** 2 - 4],
        lower=-3.0,
        upper=3.0,
    )


def steep_and_flat() -> Analytic:
    """A narrow valley at -1, deeper than a wide one at 1.5: the nominal optimum is not the robust one."""
    return Analytic(
        "valleys",
        [0.2],
        lambda x: 3 - 1.5 * np.exp(-(((x[0] + 1) / 0.12) ** 2)) - 1.2 * np.exp(-(((x[0] - 1.5) / 0.9) ** 2)),
        lower=-3.0,
        upper=3.0,
    )


def test_the_mean_of_a_polynomial():
    d = np.array([0.2, 0.5])
    problem = RobustProblem(bowl(), d, "expected")
    x = np.array([0.7, -0.4])
    (e,) = problem.evaluate(x[None], True)
    m2, m4 = d[0] ** 2 / 3, d[0] ** 4 / 5  # moments of a uniform deviation
    a = x[0]
    mean = a**4 + 6 * a**2 * m2 + m4 + 0.3 * (a**5 + 10 * a**3 * m2 + 5 * a * m4)
    mean += 2 * (x[1] ** 2 + d[1] ** 2 / 3) + a * x[1] + 9
    slope = 4 * a**3 + 12 * a * m2 + 0.3 * (5 * a**4 + 30 * a**2 * m2 + 5 * m4) + x[1]
    assert e.objective == pytest.approx(mean, rel=1e-14)
    assert e.objective_gradient == pytest.approx([slope, 4 * x[1] + a], rel=1e-13)
    assert e.constraints.size == 6 * 2
    assert problem.problem.batches == [(5, True), (1, True)]  # both constraints rise to the same corner


@pytest.mark.parametrize("kind", ["expected", "worst"])
def test_gradients_against_differences(kind):
    problem = RobustProblem(bowl(), [0.2, 0.0], kind)
    x = problem.start + 0.1
    (e,) = problem.evaluate(x[None], True)
    h = 1e-6
    for j in range(x.size):
        ahead, behind = problem.evaluate(np.array([x + h * np.eye(x.size)[j], x - h * np.eye(x.size)[j]]), False)
        assert (ahead.objective - behind.objective) / (2 * h) == pytest.approx(e.objective_gradient[j], abs=1e-7)
        np.testing.assert_allclose(
            (ahead.constraints - behind.constraints) / (2 * h), e.constraint_gradients[:, j], atol=1e-7
        )


def test_the_worst_case_of_a_quadratic():
    """|x1 - 1| and |x2| grow by d: the optimum stays, its worst case is the sum of the squares of d."""
    f = lambda x: (x[0] - 1) ** 2 + 4 * x[1] ** 2 + 2  # noqa: E731
    problem = RobustProblem(Analytic("q", [2.0, 1.0], f, lower=-5, upper=5), [0.3, 0.1], "worst")
    result = optimize(problem)
    assert result.status == "converged"
    assert result.value == pytest.approx(2 + 0.09 + 0.04, rel=1e-4)
    np.testing.assert_allclose(problem.design(result.x), [1, 0], atol=2e-2)
    assert result.names == ["x1", "x2", "beta"]


def test_constraints_hold_within_the_tolerances():
    problem = Analytic(
        "edge", [0.0, 0.0], lambda x: 10 - x[0] - x[1], lambda x: [x[0] - 1, x[1] - 2], lower=-9, upper=9
    )
    result = optimize(RobustProblem(problem, [0.25, 0.5], "worst"))
    np.testing.assert_allclose(result.x[:2], [0.75, 1.5], atol=1e-5)
    assert result.value == pytest.approx(10 - 0.75 - 1.5 + 0.75, rel=1e-6)


@pytest.mark.parametrize("kind", ["expected", "worst"])
def test_curved_constraints_hold_in_the_corners(kind):
    """Random designs within the tolerances, corners among them, of an optimum between two curved constraints."""
    d = np.array([0.3, 0.2, 0.25])
    problem = Analytic(
        "bowls",
        [0.1, 0.2, -0.1],
        lambda x: 20 - x[0] - 2 * x[1] + x[2],
        lambda x: [x[0] ** 2 + x[1] ** 2 + x[2] ** 2 - 4, np.exp(0.5 * (x[1] - x[0])) - 1.5 - 0.1 * x[2] ** 2],
        lower=-3,
        upper=3,
    )
    robust = RobustProblem(problem, d, kind)
    result = optimize(robust)
    assert result.status == "converged"
    rng = np.random.default_rng(3)
    sides = rng.choice([-1.0, 1.0], (500, 3))
    x = robust.design(result.x) + np.vstack([sides, rng.uniform(-1, 1, (1500, 3))]) * d
    worst = np.array([e.constraints for e in problem.evaluate(x, False)]).max(axis=0)
    assert worst.max() <= 1e-6
    assert worst.min() >= -1e-6  # and no farther from them than the tolerances ask for


@pytest.mark.parametrize("kind", ["expected", "worst"])
def test_a_wide_valley_beats_a_deep_one(kind):
    nominal = optimize(steep_and_flat(), start=[-1.05])
    problem = RobustProblem(steep_and_flat(), 0.25, kind)
    starts = [np.append(x, 1.0)[: problem.start.size] for x in np.linspace(-2.5, 2.5, 8)]
    robust = multistart(problem, starts=starts).best
    samples = np.random.default_rng(0).uniform(-0.25, 0.25, 200_000)

    def sampled(x):
        F = steep_and_flat().f([x + samples])
        return F.mean() if kind == "expected" else F.max()

    assert nominal.x[0] == pytest.approx(-1.0, abs=1e-2)
    assert robust.x[0] == pytest.approx(1.5, abs=1e-2)
    assert nominal.value < robust.value - 0.1
    assert sampled(robust.x[0]) == pytest.approx(robust.value, rel=1e-3)
    assert sampled(nominal.x[0]) > robust.value + 0.2


def test_a_neighbor_that_fails_is_reported():
    problem = bowl()
    problem.fails = lambda x: bool(x[0] > 0.8)
    (e,) = RobustProblem(problem, 0.2).evaluate(np.array([[0.7, 0.0]]), True)
    assert e.status == "within its tolerances: the simulation broke down"


def test_what_it_refuses():
    with refused("kind", "worse", meant="worst"):
        RobustProblem(bowl(), 0.1, "worse")
    for tolerance in (-0.1, 0.0, [0.1], np.nan):
        with refused("tolerance"):
            RobustProblem(bowl(), tolerance)
    with refused("tolerance"):
        RobustProblem(Analytic("many", [0.0] * 13, lambda x: 1 + (x**2).sum()), 0.1, "worst")
    for period in (0.0, 8.0):  # of a variable that repeats itself, designs beyond the bounds exist
        narrow = bowl()
        narrow.period = np.full(len(narrow.names), period)
        width = float(narrow.upper[0] - narrow.lower[0])
        with refused("tolerance.x1", 0.6 * width):
            RobustProblem(narrow, [0.6 * width, *[0.0] * (len(narrow.names) - 1)])
    with refused("start (inside the bounds by tolerance).x2"):
        RobustProblem(bowl(), 1.1)
    equal = bowl()
    equal.equalities = [0]
    with refused("problem"):
        RobustProblem(equal, 0.1)


def test_the_worst_case_of_a_negative_criterion():
    """x - 9 at x + 0.1: least at the lower bound, which the tolerance narrows."""
    problem = RobustProblem(Analytic("negative", [1.0], lambda x: x[0] - 9, lower=0, upper=2), 0.1, "worst")
    result = optimize(problem)
    np.testing.assert_allclose(result.x, [0.1, 1.0 - 0.9 / problem.extra.unit], atol=1e-6)
    assert result.value == pytest.approx(-8.8, abs=1e-6)
