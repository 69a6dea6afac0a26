"""The contract of an optimizer, over the registry: known optima, failures, bad input, and what a result must say of itself."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from tests.optimization.counts import error
from tests.optimization.hock_schittkowski import hock_schittkowski
from tests.optimization.structures import three_bar_truss
from tests.refused import ANY, refused
from torchmbd.optimization import OPTIMIZERS, STATUSES, Evaluation, optimize
from torchmbd.optimization.optimizer import Ending

# A method with an option that changes it altogether is a case of its own.
VARIANTS = {
    "mmfd-first-order": ("mmfd", {"second_order": False}),
}
GRADIENT_FREE = ["differential_evolution"]  # slow and inexact: tests/optimization/methods/test_evolution.py
PACKAGES = {"ipopt": "cyipopt"}  # has no wheel; every other package is installed for the tests (tests/test_packages.py)


def case(name: str):
    """Return the method's name, to be skipped where its package is not installed."""
    package = PACKAGES.get(name)
    missing = package is not None and find_spec(package) is None
    return pytest.param(name, marks=pytest.mark.skipif(missing, reason=f"{package} is not installed"))


# "auto" is one of two others: tests/optimization/methods/test_auto.py.
REGISTERED = [name for name in sorted(OPTIMIZERS) if name not in (*GRADIENT_FREE, "auto")]
METHODS = [case(name) for name in (*REGISTERED, *VARIANTS)]
CURVED = [m for m in METHODS if m.values[0] not in ("mma", "ccsaq")]  # methods that learn curvature


def solve(problem, case: str, **arguments):
    """Optimize by the method, or by the variant, of that name."""
    method, options = VARIANTS.get(case, (case, {}))
    return optimize(problem, method, **options, **arguments)


EVERYDAY = ["HS4", "HS5", "HS12", "HS21", "HS22", "HS29", "HS35", "HS43", "HS65", "HS76"]
BY_NAME = {p.name: p for p in hock_schittkowski()}


def quadratic(**changes) -> Analytic:
    """Minimum 2 at (3, -1, 0) + bounds; unequal curvatures, coupled."""
    base = {"lower": -10.0, "upper": 10.0, "optimum": 2.0} | changes
    return Analytic(
        "quadratic",
        [7.0, 4.0, -5.0],
        lambda x: (x[0] - 3) ** 2 + 4 * (x[1] + 1) ** 2 + 0.5 * x[2] ** 2 + (x[0] - 3) * (x[1] + 1) + 2,
        **base,
    )


def cut_circle() -> Analytic:
    """min x + y on the unit disk where x >= -0.6: optimum at (-0.6, -0.8), both constraints active."""
    return Analytic(
        "cut circle",
        [0.5, 0.5],
        lambda x: x[0] + x[1] + 10,
        lambda x: [x[0] ** 2 + x[1] ** 2 - 1, -0.6 - x[0]],
        lower=-2.0,
        upper=2.0,
        optimum=8.6,
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", EVERYDAY)
def test_known_optimum(method, name):
    problem = BY_NAME[name]
    result = solve(problem, method, max_iterations=500)
    assert result.status == "converged"
    assert error(problem, result.value) <= 1e-4
    assert result.violation <= 1e-6


@pytest.mark.parametrize(
    ("method", "package", "remedy"),
    [
        ("mma", "nlopt", "pip install 'torchmbd[nlopt]'"),
        ("ccsaq", "nlopt", "pip install 'torchmbd[nlopt]'"),
        ("ipopt", "cyipopt", "conda install"),
    ],
)
def test_a_missing_package_is_named(monkeypatch, method, package, remedy):
    monkeypatch.setitem(sys.modules, package, None)
    with refused("method", method, package, remedy):
        optimize(quadratic(), method)


@pytest.mark.parametrize("method", CURVED)
def test_curved_valley(method):
    """Rosenbrock's: for methods that learn curvature; separable approximations creep along it."""
    result = solve(BY_NAME["HS1"], method, max_iterations=500)
    assert result.status == "converged"
    assert result.value <= 1e-4


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("make", [quadratic, cut_circle, three_bar_truss])
def test_result_says_what_happened(method, make):
    problem = make()
    seen = []
    result = solve(problem, method, callback=seen.append, max_iterations=500)
    assert result.status == "converged"
    assert error(problem, result.value) <= 1e-4
    assert result.kkt_residual <= 1e-2
    assert result.message
    assert [i.iteration for i in result.history] == list(range(result.iterations + 1))
    assert [i.objective for i in seen] == [i.objective for i in result.history]
    assert np.array_equal(result.history[0].x, problem.start)
    again = problem.evaluate(result.x[None], True)[0]
    assert again.objective == result.value
    assert np.array_equal(again.constraints, result.constraints)
    lanes = sum(count for count, _ in problem.batches[:-1])
    assert result.analyses == lanes
    assert result.gradient_evaluations == sum(count for count, gradients in problem.batches[:-1] if gradients)


@pytest.mark.thorough("trust-constr")
@pytest.mark.parametrize("method", METHODS)
def test_multipliers_are_sensitivities(method):
    """In physical units: the optimum falls by multiplier times the amount by which a limit is relaxed."""

    def rod(limit: float) -> Analytic:
        return Analytic(
            "rod",
            [400.0, 3.0],
            lambda x: 7 * x[0] * x[1],
            lambda x: [limit / (x[0] * x[1] ** 2) - 1],
            lower=1.0,
            upper=500.0,
        )

    result = solve(rod(2000.0), method, feasibility=1e-8, max_iterations=500)
    step = 20.0
    ahead, behind = (solve(rod(2000.0 + d), method, feasibility=1e-8, max_iterations=500).value for d in (step, -step))
    # d value / d limit = multiplier * d c / d limit, and c = limit / (...) - 1 with (...) = limit at the optimum
    assert (ahead - behind) / (2 * step) == pytest.approx(result.multipliers[0] / 2000.0, rel=5e-3)
    # f* = 7 sqrt(limit * lower) with the first variable on its lower bound, so d f* / d lower = 3.5 sqrt(limit)
    assert result.bound_multipliers[0] == pytest.approx(-3.5 * np.sqrt(2000.0), rel=5e-3)


@pytest.mark.parametrize("method", METHODS)
def test_infeasible_start_is_restored(method):
    problem = cut_circle()
    result = solve(problem, method, start=[-1.5, 1.5], max_iterations=500)
    assert result.history[0].violation > 1.0
    assert result.status == "converged"
    assert result.value == pytest.approx(8.6, abs=1e-4)
    first = next(i for i in result.history if i.violation <= 1e-6)
    assert f"the start violated a constraint by 3.5, designs are feasible since iteration {first.iteration}" in (
        result.message
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("reason", ["status", "objective", "gradient", "constraint"])
def test_failures_in_part_of_the_domain_are_stepped_back_from(method, reason):
    """The minimum of f lies where the simulation breaks down: the end is better than the start, and its numbers are real."""

    class Breaking(Analytic):
        def _one(self, x, gradients):
            good = super()._one(x, gradients)
            if x[0] >= 2.0:
                return good
            if reason == "status":
                return Evaluation.failure("step size underflow")
            nan = np.nan
            return Evaluation(
                nan if reason == "objective" else good.objective,
                good.constraints * nan if reason == "constraint" else good.constraints,
                None if not gradients else good.objective_gradient * (nan if reason == "gradient" else 1.0),
                good.constraint_gradients,
            )

    problem = Breaking(
        "breaking",
        [5.0, 5.0],
        lambda x: (x[0] - 1) ** 2 + (x[1] - 1) ** 2 + 1,
        lambda x: [x[1] - 40],
        lower=-9,
        upper=9,
    )
    result = solve(problem, method, max_iterations=60)
    # The wall is no minimum.
    assert result.status == ("many_failures" if result.failures > 0.1 * result.analyses else "stalled")
    assert "stalled: " in result.message or result.status == "stalled"
    assert "the way down leads into designs that fail" in result.message
    assert result.failures > 0
    assert result.x[0] >= 2.0
    assert np.isfinite(result.value)
    assert result.value < result.history[0].objective
    assert all(np.isfinite(i.objective) for i in result.history)


@pytest.mark.parametrize("method", [*METHODS, "differential_evolution"])
@pytest.mark.parametrize("seed", range(3))
def test_a_gradient_that_fails_where_the_values_do_not(method, seed):
    """Asked for afterwards, gradients fail by chance: what is reported are the values of a design that was evaluated."""
    chance = np.random.default_rng(seed)

    class Moody(Analytic):
        def _one(self, x, gradients):
            good = super()._one(x, gradients)
            fails = gradients and len(self.points) > 1 and (method == "differential_evolution" or chance.random() < 0.4)
            return Evaluation.failure("out of memory") if fails else good

    problem = Moody(
        "moody",
        [5.0, 4.0],
        lambda x: (x[0] - 1) ** 2 + x[0] * x[1] + x[1] ** 2 + 1,
        lambda x: [3 - x[0]],
        lower=-9,
        upper=9,
    )
    result = solve(problem, method, max_iterations=20, eager_gradients=False)
    assert result.status in STATUSES
    assert result.failures > 0
    assert result.value == pytest.approx(problem.f(result.x), rel=1e-12)
    assert result.value <= result.history[0].objective
    assert np.isnan(result.kkt_residual) == ("; its gradient could not be evaluated" in result.message)


@pytest.mark.parametrize("method", METHODS)
def test_a_narrow_failure_on_the_way_is_passed(method):
    problem = Analytic(
        "hole",
        [4.0, 4.0],
        lambda x: (x[0] - 1) ** 2 + 3 * (x[1] - 1) ** 2 + 1,
        lower=-9,
        upper=9,
        optimum=1.0,
        fails=lambda x: bool(abs(x[0] + 2) + abs(x[1] + 2) < 2.5),
    )
    result = solve(problem, method, max_iterations=200)
    assert result.status == "converged"
    assert result.value == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_failing_start(method):
    problem = quadratic(fails=lambda x: True)
    result = solve(problem, method)
    assert result.status == "failed"
    assert "broke down" in result.message
    assert result.analyses == result.failures == len(problem.points)
    assert len(problem.batches) == 1
    assert np.isnan(result.value)


@pytest.mark.parametrize("method", METHODS)
def test_contradictory_constraints(method):
    problem = Analytic(
        "contradiction",
        [3.0, 0.0],
        lambda x: x[0] ** 2 + x[1] ** 2 + 1,
        lambda x: [x[0] + 1, 1 - x[0], x[1] - 4],
        lower=-5,
        upper=5,
    )
    result = solve(problem, method, max_iterations=200)
    assert result.status == "infeasible"
    assert result.violation == pytest.approx(1.0, abs=1e-6)  # at x1 = 0, and no design has less
    assert "constraints [0, 1] conflict" in result.message


@pytest.mark.parametrize("method", METHODS)
def test_objective_independent_of_the_variables(method):
    problem = Analytic("constant", [1.0, 2.0], lambda x: 5.0 + 0 * x[0], lower=0.0, upper=3.0)
    result = solve(problem, method)
    assert result.status == "converged"
    assert result.value == 5.0
    assert len(problem.batches) <= 3
    assert "depend" in result.message


@pytest.mark.parametrize("method", METHODS)
def test_leaves_a_symmetric_maximum(method):
    """90 degrees: the gradient vanishes by symmetry, and the bound lies there as well."""
    problem = Analytic(
        "angle", [90.0, -90.0], lambda x: 3 - np.cos(x[0] * np.pi / 90) - np.cos(x[1] * np.pi / 90), lower=-90, upper=90
    )
    result = solve(problem, method)
    assert result.status == "converged"
    assert result.value == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_fixed_variable_stays(method):
    problem = quadratic(lower=[-10, 4.0, -10], upper=[10, 4.0, 10])
    result = solve(problem, method, max_iterations=500)
    assert result.status == "converged"
    assert result.x[1] == 4.0
    assert result.x[0] == pytest.approx(0.5, abs=0.05)  # 3 - (4 + 1) / 2


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("limit", [4.0, 2.0])
def test_all_variables_fixed(method, limit):
    """As in a box of a discrete search: nothing is left to search."""
    problem = Analytic("point", [1.0, 2.0], lambda x: x[0] ** 2 + 1, lambda x: [x[0] + x[1] - limit])
    problem.lower = problem.upper = problem.start
    result = solve(problem, method)
    assert result.status == ("converged" if limit == 4.0 else "infeasible")
    assert np.array_equal(result.x, [1.0, 2.0])
    assert problem.functions == 1


@pytest.mark.parametrize("method", METHODS)
def test_path_does_not_depend_on_units(method):
    """Degrees or radians, joule or millijoule: the same analyses and the same design."""

    def angles(unit: float, energy: float) -> Analytic:
        def f(x):
            return energy * (
                1.2
                - np.cos(2 * x[0] * unit)
                + 0.3 * np.sin(x[1] * unit - 0.4) ** 2
                + 0.1 * np.sin(x[0] * unit + x[1] * unit)
            )

        return Analytic("angles", [0.7 / unit, -0.9 / unit], f, lower=-1.5 / unit, upper=1.5 / unit)

    a, b = solve(angles(1.0, 1.0), method), solve(angles(np.pi / 180, 1e-3), method)
    assert a.analyses == b.analyses
    assert np.allclose(a.x, b.x * np.pi / 180, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_interruption_keeps_the_best(method):
    problem = quadratic()
    inner, calls = problem.evaluate, []

    def evaluate(X, gradients):
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(len(X))
        return inner(X, gradients)

    problem.evaluate = evaluate
    result = solve(problem, method)
    assert result.status == "interrupted"
    assert result.analyses == sum(calls)
    assert result.value <= result.history[0].objective
    assert np.isfinite(result.kkt_residual)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("iterations", range(1, 12))
def test_a_better_design_that_is_nearly_feasible_is_corrected(method, iterations):
    """From a feasible start along a curved limit, which methods meet at their end only."""
    seen = []

    class Kept(Analytic):
        def _one(self, x, gradients):
            evaluation = super()._one(x, gradients)
            seen.append(evaluation)
            return evaluation

    problem = Kept(
        "bent tube",
        [3.0, 1.0, -1.0],
        lambda x: x[0] + 0.02 * x[1] ** 2 + 0.01 * x[2] ** 2,
        lambda x: [1.0 - x[0] * (1.0 + 0.2 * np.cos(2 * x[1]) * np.cos(x[2])) / 1.2, 0.5 / x[0] - np.cos(x[1])],
        lower=[0.1, -1.5, -1.5],
        upper=[5.0, 1.5, 1.5],
    )
    result = solve(problem, method, max_iterations=iterations)
    assert result.violation <= 1e-6
    near = min(e.objective for e in seen if e.ok and e.constraints.max() <= 1e-3)
    assert result.value <= 1.005 * near


@pytest.mark.parametrize("method", METHODS)
def test_limit_of_iterations(method):
    result = solve(BY_NAME["HS38"], method, max_iterations=2)
    assert result.status == "max_iterations"
    assert result.iterations <= 3


@pytest.mark.parametrize("method", METHODS)
def test_limit_of_analyses(method):
    problem = BY_NAME["HS43"]
    problem.reset()
    result = solve(problem, method, max_analyses=4)
    assert result.status == "max_iterations"
    assert "4 analyses" in result.message
    assert result.analyses == sum(lanes for lanes, _ in problem.batches) == 4
    assert result.violation <= 1e-6  # the start is feasible, so the best design is
    assert result.value <= result.history[0].objective


@pytest.mark.parametrize("method", METHODS)
def test_equalities_are_met_or_refused(method):
    problem = Analytic(
        "line", [4.0, 4.0], lambda x: x[0] ** 2 + 2 * x[1] ** 2 + 1, lambda x: [x[0] + x[1] - 3], lower=-9, upper=9
    )
    problem.equalities = [0]
    if method in ("sqcqp", "slsqp", "trust-constr", "ipopt", "lbfgs"):
        result = solve(problem, method, max_iterations=200)
        assert result.status == "converged"
        assert np.allclose(result.x, [2, 1], atol=1e-3)
        assert result.multipliers[0] == pytest.approx(-4.0, rel=1e-2)
    else:
        with refused("method"):
            solve(problem, method)
        assert problem.batches == []


EARLY = {
    "sqcqp": {"ftol": 1e-1},
    "slsqp": {"ftol": 1e-1},
    "mma": {"ftol": 1e-2, "xtol": 1e-2},
    "ccsaq": {"ftol": 1e-2},
    "mmfd": {"delobj": 1e-2},
}


@pytest.mark.parametrize("method", EARLY)
@pytest.mark.parametrize("name", ["HS5", "HS12", "HS43", "HS65"])
def test_the_residual_decides_where_a_method_stops_early(method, name):
    problem = BY_NAME[name]
    result = optimize(problem, method, max_iterations=500, **EARLY[method])
    assert result.status == ("converged" if result.kkt_residual <= 1e-3 else "stalled")
    assert error(problem, result.value) <= 1e-3


def test_a_method_that_claims_an_optimum_where_there_is_none(monkeypatch):
    def hasty(search, max_iterations: int, *, kkt: float = 1e-3) -> Ending:
        search.begin()
        return Ending(search.start, "converged", "that will do")

    monkeypatch.setitem(OPTIMIZERS, "hasty", hasty)
    result = optimize(quadratic(), "hasty")
    assert result.status == "stalled"
    assert result.kkt_residual > 0.1
    assert f"but the Kuhn-Tucker residual {result.kkt_residual:.2g} is beyond kkt = 0.001" in result.message
    assert optimize(quadratic(), "hasty", kkt=1e3).status == "converged"
    assert "KKT residual" in str(result)


def test_crossed_bounds_are_named():
    with refused("lower.x2"):
        optimize(quadratic(lower=[-10, 3, -10], upper=[10, 1, 10]))


def test_start_outside_the_bounds_is_named():
    with refused("start.x3"):
        optimize(quadratic(), start=[0, 0, 11])
    with refused("start.x1"):
        optimize(quadratic(), start=[np.nan, 0, 0])


def test_wrong_names_are_answered_with_the_nearest():
    with refused("method", "mfd", meant="mmfd"):
        optimize(quadratic(), "mfd")
    with refused("delobjs", 0.001, "Try: 'delobj'"):
        optimize(quadratic(), "mmfd", delobjs=1e-3)
    with refused("ct", 0.03):
        optimize(quadratic(), "mmfd", ct=0.03)


def test_wrong_lengths_are_named():
    with refused("start"):
        optimize(quadratic(), start=[0, 0])


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"problem": None}, ("problem",)),
        ({"max_iterations": 2.5}, ("max_iterations", 2.5)),
        ({"max_iterations": "3"}, ("max_iterations", "3")),
        ({"max_analyses": 0}, ("max_analyses", 0)),
        ({"start": "x"}, ("start", "x")),
        ({"feasibility": "x"}, ("feasibility", "x")),
        ({"method": "differential_evolution", "population": 4.5}, ("population", 4.5)),
    ],
)
def test_arguments_of_a_wrong_kind_are_named(given, fault):
    with refused(*fault):
        optimize(**({"problem": quadratic()} | given))


def test_gradients_of_wrong_shape_are_named():
    problem = quadratic()
    problem.evaluate = lambda X, gradients: [Evaluation(1.0, np.zeros(0), np.zeros(2), np.zeros((0, 2)))]
    with refused("problem.evaluate", ANY, "(2,) and (0, 3)", "(3,)"):
        optimize(problem)


def test_motion_is_asked_for_only_when_wanted():
    problem = quadratic()
    asked = []
    problem.motion = lambda x: asked.append(x) or "motion"
    result = optimize(problem)
    assert asked == []
    assert result.motion == "motion"
    assert result.motion == "motion"
    assert len(asked) == 1
    with pytest.raises(AttributeError, match="offers no motion"):
        optimize(quadratic()).motion  # noqa: B018
