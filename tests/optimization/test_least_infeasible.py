"""Contradictions of known size: where they are least, and who takes part in them."""

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from tests.optimization.laminated_tube import laminated_tube
from torchmbd.optimization import optimize
from torchmbd.optimization.least_infeasible import least_infeasible
from torchmbd.optimization.search import Search


def least_of(problem: Analytic):
    equalities = getattr(problem, "equalities", None)
    search = Search(problem.evaluate, problem.start, problem.lower, problem.upper, equalities=equalities)
    search.begin()
    return least_infeasible(search, search.start), problem


def test_two_disks_apart():
    """Unit disks around (-2, 0) and (2, 0): the same violation 3 at the origin; a third constraint stays out of it."""
    problem = Analytic(
        "disks",
        [1.0, 1.5],
        lambda x: x[1],
        lambda x: [(x[0] + 2) ** 2 + x[1] ** 2 - 1, (x[0] - 2) ** 2 + x[1] ** 2 - 1, x[0] - 3],
        lower=-5,
        upper=5,
    )
    least, _ = least_of(problem)
    assert least.violation == pytest.approx(3.0, abs=1e-5)
    assert np.allclose(least.y, 0.0, atol=1e-3)
    assert least.conflicting == [0, 1]
    assert problem.functions <= 15


def test_one_constraint_against_a_bound():
    least, _ = least_of(
        Analytic("bound", [0.5, 0.0], lambda x: x[0], lambda x: [3 - x[0] + x[1] ** 2], lower=-1, upper=1)
    )
    assert least.violation == pytest.approx(2.0, abs=1e-6)
    assert least.conflicting == [0]


def test_equality_against_inequality():
    problem = Analytic(
        "line", [2.0, 0.0], lambda x: x[0], lambda x: [x[0] + x[1] - 4, x[0] + x[1] - 1], lower=-5, upper=5
    )
    problem.equalities = [0]
    least, _ = least_of(problem)
    assert least.violation == pytest.approx(1.5, abs=1e-6)  # halfway between 1 and 4
    assert least.conflicting == [0, 1]


def test_a_stationary_violation_that_is_not_the_least():
    """All plies across the tube: the violation is stationary by symmetry, and largest there."""
    problem = laminated_tube([1.0, -np.pi / 2, np.pi / 2, np.pi / 2])
    least, _ = least_of(problem)
    assert least.violation == 0.0


def test_the_violation_is_that_of_the_design():
    """Six variables at maxima of one constraint, which no design meets."""
    f = lambda x: [25 + sum((6 - k) * (np.cos(x[k]) - 1) for k in range(6))]  # noqa: E731
    problem = Analytic("six", [0.0] * 6, lambda x: x[0], f, lower=-1.5, upper=1.5)
    least, _ = least_of(problem)
    assert least.violation == pytest.approx(f(least.y)[0])
    assert least.violation == pytest.approx(25 + 21 * (np.cos(1.5) - 1), rel=1e-6)


def test_a_feasible_design_ends_the_search_for_one():
    problem = Analytic("disk", [4.0, 4.0], lambda x: x[0], lambda x: [x[0] ** 2 + x[1] ** 2 - 1], lower=-5, upper=5)
    least, _ = least_of(problem)
    assert least.violation == 0.0


@pytest.mark.parametrize("start", [[1.0, -1.384, -1.408, 0.012], [0.4, -1.49, -1.511, -0.03], [0.7, 0.97, 1.32, -0.72]])
def test_few_simulations_make_a_curved_problem_feasible(start):
    """The end is the first feasible design, not one well inside the limits."""
    problem = laminated_tube(start)
    least, _ = least_of(problem)
    assert least.violation <= 1e-6
    assert problem.functions <= 25


def test_a_design_that_fails_shortens_the_step():
    problem = Analytic(
        "disk",
        [4.0, 4.0],
        lambda x: x[0],
        lambda x: [x[0] ** 2 + x[1] ** 2 - 1],
        lower=-5,
        upper=5,
        fails=lambda x: x[0] ** 2 + x[1] ** 2 < 0.7,
    )
    least, _ = least_of(problem)
    assert least.violation <= 1e-6


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0, 3.0])
def test_waves_of_the_steps_do_not_hide_a_feasible_design(phase, unit):
    """Waves of 0.5 % are steeper than the constraint itself, so its slopes are those of the waves."""
    waves = lambda x: 0.005 * np.sin(1500.0 * x[0] / unit + phase) + 0.005 * np.sin(900.0 * x[1] / unit)  # noqa: E731
    problem = Analytic(
        "waves",
        [0.3 * unit, 0.5 * unit],
        lambda x: (x[0] + x[1]) / unit,
        lambda x: [1.5 * unit / (x[0] + x[1]) - 1.0 + waves(x)],
        lower=0.1 * unit,
        upper=unit,
    )
    result = optimize(problem)
    assert result.violation <= 1e-6
    assert result.status != "infeasible"


def test_no_design_beside_a_least_infeasible_one_violates_less():
    """The least violation of 0.3 lies between waves, some of which end the steps along gradients."""
    waves = lambda x: 0.02 * np.sin(700.0 * x[0])  # noqa: E731
    problem = Analytic("hill", [0.9], lambda x: x[0], lambda x: [0.3 + (x[0] - 0.2) ** 2 + waves(x)], lower=0, upper=1)
    least, _ = least_of(problem)
    assert least.conflicting == [0]
    beside = np.clip(least.y[0] + np.array([0.25, 0.0625, -0.0625, -0.25]), 0.0, 1.0)
    assert all(problem.c(np.array([x]))[0] >= (1.0 - 1e-3) * least.violation for x in beside)


def test_a_method_that_gave_up_goes_on_from_the_feasible_design(monkeypatch):
    """A method that says "infeasible" once, without trying: optimize() finds a feasible design and calls it again."""
    from torchmbd.optimization import OPTIMIZERS
    from torchmbd.optimization.optimizer import Ending

    calls = []

    def lazy(search, max_iterations):
        search.begin()
        calls.append(max_iterations)
        return (
            Ending(search.start, "infeasible", "no idea")
            if len(calls) == 1
            else OPTIMIZERS["mmfd"](search, max_iterations)
        )

    monkeypatch.setitem(OPTIMIZERS, "lazy", lazy)
    problem = Analytic("disk", [4.0, 4.0], lambda x: x[0] + 3, lambda x: [x[0] ** 2 + x[1] ** 2 - 1], lower=-5, upper=5)
    result = optimize(problem, "lazy")
    assert result.status == "converged"
    assert result.value == pytest.approx(2.0, abs=1e-5)
    assert [i.iteration for i in result.history] == list(range(len(result.history)))
    assert len(calls) == 2
