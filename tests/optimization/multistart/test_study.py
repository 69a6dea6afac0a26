"""Multistart: what is simulated together, the same whatever the timing, and how it is stopped."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from tests.refused import ANY, refused
from torchmbd.optimization import Evaluation, latin_hypercube, optimize, sobol, starts_at
from torchmbd.optimization.multistart import multistart
from torchmbd.optimization.multistart.run import distinct_minima

METHODS = ["mmfd", "slsqp"]


def waves(**changes) -> Analytic:
    """Three minima in x1 (near -1.9, 0, 1.9; values 1 at 0, about 1.2 beside it), one in x2; nothing known in x2 > 3.5."""
    base = {"lower": -3.0, "upper": 4.0} | changes
    return Analytic(
        "waves",
        [2.5, 3.0],
        lambda x: 2 - np.cos(3.2 * x[0]) + 0.05 * x[0] ** 2 + 0.3 * (x[1] - 0.5 * x[0]) ** 2,
        lambda x: [x[0] ** 2 / 30 + x[1] / 9 - 1],
        **base,
    )


@pytest.mark.parametrize("method", METHODS)
def test_every_start_ends_as_it_would_alone(method):
    problem = waves()
    study = multistart(problem, method, sobol(6, seed=3))
    assert [r.start for r in study.results] == list(range(6))
    for start, together in zip(study.starts, study.results, strict=True):
        alone = multistart(waves(), method, starts_at([start])).results[0]
        assert np.array_equal(alone.x, together.x)
        assert alone.analyses == together.analyses
        assert [i.objective for i in alone.history] == [i.objective for i in together.history]


@pytest.mark.parametrize("method", METHODS)
def test_simulations_are_one_batch_per_turn(method, monkeypatch):
    problem = waves()
    # one design at a time: searches ask for several only to check the curvature at the end
    monkeypatch.setattr("torchmbd.optimization.curvature.MOST_DIRECTIONS", 0)
    options = {"second_order": False} if method == "mmfd" else {}
    study = multistart(problem, method, sobol(8, seed=1), **options)
    assert all(gradients for _, gradients in problem.batches)
    sizes = [lanes for lanes, _ in problem.batches]
    assert sizes[0] == 8
    assert sizes == sorted(sizes, reverse=True)  # starts only end, so batches only shrink
    assert sum(sizes) == study.analyses
    assert len(sizes) == max(r.analyses for r in study.results)


def test_large_batches_are_cut_to_the_lanes():
    problem = waves()
    options = {"population": 15, "max_iterations": 3}
    multistart(problem, "differential_evolution", sobol(1, seed=1), max_lanes=10, **options)
    sizes = [lanes for lanes, _ in problem.batches]
    assert max(sizes) == 10
    assert sizes[2:5] == [10, 10, 9]  # the first generation is 30 designs, one of them known


def test_values_and_gradients_are_batches_of_their_own():
    problem = waves()
    study = multistart(problem, "slsqp", sobol(8, seed=1), eager_gradients=False)
    assert {gradients for _, gradients in problem.batches} == {True, False}
    assert sum(lanes for lanes, gradients in problem.batches if gradients) == study.gradient_evaluations
    assert sum(lanes for lanes, _ in problem.batches) == study.analyses


@pytest.mark.parametrize("max_lanes", [1, 3, 8])
def test_lanes_are_limited_and_refilled(max_lanes):
    problem = waves()
    study = multistart(problem, "mmfd", sobol(8, seed=1), max_lanes=max_lanes, second_order=False)
    sizes = [lanes for lanes, _ in problem.batches]
    assert max(sizes) == max_lanes
    begun = len(sizes) - sum(1 for size in sizes if size < max_lanes)
    assert all(size == max_lanes for size in sizes[:begun])  # full until no start is left to begin
    assert len(study.results) == 8
    free = multistart(waves(), "mmfd", sobol(8, seed=1), second_order=False)
    assert [r.value for r in study.results] == [r.value for r in free.results]


@pytest.mark.thorough
def test_batches_do_not_depend_on_timing():
    """Callbacks and evaluations that dawdle at random change nothing, neither batches nor reports."""

    def run(seed: int):
        rng = np.random.default_rng(seed)
        problem, reports, batches = waves(), [], []
        inner = problem.evaluate

        def evaluate(X, gradients):
            batches.append(X.copy())
            time.sleep(0.002 * rng.random())
            return inner(X, gradients)

        problem.evaluate = evaluate

        def callback(iterate):
            time.sleep(0.0005 * rng.random())
            reports.append((iterate.start, iterate.iteration, iterate.objective))

        multistart(problem, "mmfd", sobol(6, seed=5), callback=callback, max_lanes=4)
        return reports, batches

    (reports, batches), (others, other_batches) = run(0), run(1)
    assert {start for start, _, _ in reports} == set(range(6))
    assert reports == others
    assert all(np.array_equal(a, b) for a, b in zip(batches, other_batches, strict=True))


def test_problem_and_callback_live_in_the_callers_thread():
    problem, threads = waves(), set()
    inner = problem.evaluate

    def evaluate(X, gradients):
        threads.add(threading.current_thread())
        return inner(X, gradients)

    problem.evaluate = evaluate
    multistart(problem, "mmfd", sobol(4, seed=5), callback=lambda iterate: threads.add(threading.current_thread()))
    assert threads == {threading.current_thread()}


@pytest.mark.parametrize("method", METHODS)
def test_interruption_returns_what_there_is(method):
    problem, calls, reports = waves(), [], []
    inner = problem.evaluate

    def evaluate(X, gradients):
        calls.append(len(X))
        if len(calls) == 6:
            raise KeyboardInterrupt
        return inner(X, gradients)

    problem.evaluate = evaluate
    before = threading.active_count()
    study = multistart(
        problem, method, [[0.1, 0.1], [2.5, 3.0], [-2.0, 2.0], [1.0, 1.0]], callback=reports.append, max_lanes=3
    )
    assert study.interrupted
    assert threading.active_count() == before
    assert {r.status for r in study.results} >= {"interrupted"}
    assert {r.status for r in study.results} <= {"interrupted", "converged"}
    assert study.best is not None
    assert study.best.value <= min(i.objective for i in reports if i.violation <= 1e-6)
    assert len(reports) == sum(len(r.history) for r in study.results)


def test_results_are_reported_as_they_come():
    reported, problem = [], waves()
    before: dict[int, int] = {}  # batches until a start had ended

    def ended(result):
        reported.append(result)
        before[result.start] = len(problem.batches)

    study = multistart(problem, "mmfd", sobol(6, seed=5), ended=ended, max_lanes=3, second_order=False)
    assert sorted(reported, key=lambda result: result.start) == study.results
    assert min(before.values()) < max(before.values()) == len(problem.batches)


def test_interruption_inside_the_callback():
    raised = []

    def callback(iterate):
        if iterate.iteration == 2 and not raised:
            raised.append(iterate)
            raise KeyboardInterrupt

    study = multistart(waves(), "mmfd", sobol(4, seed=5), callback=callback)
    assert study.interrupted
    assert len(study.results) == 4


@pytest.mark.parametrize("where", ["evaluate", "callback"])
def test_errors_come_out_and_leave_no_thread(where):
    problem = waves()

    def broken(*_):
        raise ZeroDivisionError("a bug of the user's")

    before = threading.active_count()
    if where == "evaluate":
        problem.evaluate = broken
    with pytest.raises(ZeroDivisionError, match="a bug of the user's"):
        multistart(problem, "mmfd", sobol(4, seed=5), callback=broken if where == "callback" else None)
    assert threading.active_count() == before


def test_an_error_inside_one_start_comes_out():
    problem = waves()
    problem.evaluate = lambda X, gradients: [Evaluation(1.0, np.zeros(1), np.zeros(5), np.zeros((1, 2))) for _ in X]
    with refused("problem.evaluate", ANY, "gradients of shape"):
        multistart(problem, "mmfd", sobol(4, seed=5))


def test_too_few_answers_are_refused():
    problem = waves()
    problem.evaluate = lambda X, gradients: []
    with refused("problem.evaluate", ANY, "0 evaluations for 4 designs"):
        multistart(problem, "mmfd", sobol(4, seed=5))


@pytest.mark.parametrize("method", METHODS)
def test_one_failing_lane_leaves_the_others_alone(method):
    problem = waves(fails=lambda x: x[1] > 3.2)
    starts = [[0.1, 0.1], [1.0, 3.5], [-2.0, 2.0]]
    study = multistart(problem, method, starts)
    assert study.results[1].status == "failed"
    assert study.results[0].converged
    assert study.results[2].converged
    assert study.best is min(study.results[::2], key=lambda r: r.value)


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS)
def test_minima_are_separated_and_counted(method):
    study = multistart(waves(), method, sobol(24, seed=2))
    assert study.converged == 24
    assert len(study.minima) == 4
    assert sum(m.count for m in study.minima) == 24
    assert study.minima[0].value == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(study.minima[0].x, 0.0, atol=1e-2)
    assert [m.value for m in study.minima] == sorted(m.value for m in study.minima)
    # Boender and Rinnooy Kan by hand: w (N - 1) / (N - w - 2) with N = 24, w = 4.
    assert study.minima_left == pytest.approx(4 * 23 / 18 - 4)
    assert study.covered == pytest.approx(19 * 28 / (24 * 23))


def test_angles_are_compared_on_the_circle():
    problem = Analytic("period", [1.0], lambda x: 2 - np.cos(2 * (x[0] - 1.5)), lower=-np.pi / 2, upper=np.pi / 2)
    starts = [[1.2], [0.5], [-1.56]]  # the last runs into the bound at -pi/2, which is the same laminate as +pi/2
    assert len(multistart(problem, "mmfd", starts).minima) == 2
    problem.period = [np.pi]
    ends = multistart(problem, "mmfd", starts)
    assert len(ends.minima) == 2  # 1.5 and the bound are 0.07 apart


@pytest.mark.parametrize(
    ("degrees", "count"),
    [
        ((89.9, -89.9), 1),
        ((-89.9, 89.9), 1),
        ((10.0, 190.0), 1),
        ((80.0, -80.0), 2),
        ((0.0, 90.0), 2),
        ((45.0, -45.0), 2),
    ],
)
def test_ply_angles_repeat_after_half_a_turn(degrees, count):
    """The second variable, a length, does not repeat itself."""
    problem = Analytic("flat", [0.0, 1.0], lambda x: 1.0 + 0.0 * x[0])
    ends = multistart(problem, "mmfd", [[angle, 1.0] for angle in np.radians(degrees)], scaling=False).results
    assert [tuple(np.degrees(end.x[:1])) for end in ends] == [pytest.approx((angle,)) for angle in degrees]
    span, period = np.array([np.pi, 2.0]), np.array([np.pi, 0.0])
    assert len(distinct_minima(ends, span, period=period)) == count
    assert len(distinct_minima(ends, span)) == 2
    apart = [ends[0], replace(ends[1], x=ends[1].x + np.array([0.0, np.pi]))]
    assert len(distinct_minima(apart, span, period=period)) == 2


@pytest.mark.parametrize(("factor", "constant"), [(1.0, 1e4), (1.0, -1e4), (1e-6, 0.0), (1e3, -7.0)])
def test_neither_a_constant_nor_a_unit_of_the_objective_joins_minima(factor, constant):
    """Two valleys, of which one is deeper by a tenth of what the searches gain."""
    problem = Analytic("valleys", [0.6], lambda x: 16 * (x[0] ** 2 - 0.25) ** 2 + 0.5 * x[0], lower=-100, upper=100)
    ends = multistart(problem, "mmfd", [[0.6], [-0.6], [0.55]]).results
    changed = [
        replace(
            end,
            value=factor * end.value + constant,
            history=[replace(entry, objective=factor * entry.objective + constant) for entry in end.history],
        )
        for end in ends
    ]
    for results in (ends, changed):
        assert [minimum.starts for minimum in distinct_minima(results, np.array([200.0]))] == [[1], [0, 2]]


@pytest.mark.thorough
def test_no_further_start_once_all_minima_are_known():
    problem = waves(lower=[-0.9, -3.0], upper=[0.9, 3.0])
    problem.start = np.zeros(2)
    study = multistart(problem, "mmfd", sobol(40, seed=2), max_lanes=4, minima_left=0.5)
    assert study.stopped_early
    assert len(study.minima) == 1
    assert study.minima_left <= 0.5
    assert len(study.results) < 12


def test_all_starts_share_one_scale():
    """A start near zero must not have its own tiny unit: both starts take the problem's."""
    problem = waves()
    study = multistart(problem, "mmfd", [[0.01, 2.9], [2.5, 2.9]])
    assert study.minima[0].value == pytest.approx(1.0, abs=1e-6)
    assert study.results[0].analyses <= 20


@pytest.mark.parametrize("recipe", [sobol, latin_hypercube])
def test_samples_fill_the_bounds(recipe):
    problem = waves(lower=[-3.0, 10.0], upper=[4.0, 11.0])
    X = recipe(16, seed=4).points(problem)
    assert X.shape == (16, 2)
    unit = (X - [-3.0, 10.0]) / [7.0, 1.0]
    assert unit.min() >= 0.0
    assert unit.max() <= 1.0
    for k in range(2):  # one point in every sixteenth of each range: what both recipes promise for 16 points
        assert sorted((unit[:, k] * 16).astype(int)) == list(range(16))
    assert np.array_equal(X, recipe(16, seed=4).points(problem))
    assert not np.array_equal(X, recipe(16, seed=5).points(problem))
    with_initial = recipe(16, seed=4, include_initial=True).points(problem)
    assert with_initial.shape == (16, 2)
    assert np.array_equal(with_initial[0], problem.start)


def test_sobol_points_of_a_longer_sequence_begin_alike():
    problem = waves()
    assert np.array_equal(sobol(5, seed=4).points(problem), sobol(8, seed=4).points(problem)[:5])


def test_starts_need_finite_bounds():
    with refused("bounds.x2"):
        multistart(waves(upper=[4.0, np.inf]), "mmfd", sobol(4, seed=1))


def test_every_start_has_its_own_limit_of_analyses():
    study = multistart(waves(), "mmfd", sobol(5, seed=1), max_analyses=3)
    assert [r.analyses for r in study.results] == [3] * 5
    assert {r.status for r in study.results} == {"max_iterations"}
    assert study.best is not None


def test_the_best_is_feasible_by_the_tolerance_that_was_given():
    problem = Analytic("corner", [2.0, 2.0], lambda x: x[0] + x[1], lambda x: [1 - x[0] * x[1]], lower=0.1, upper=5.0)
    study = multistart(problem, "lbfgs", feasibility=1e-2)
    assert 1e-5 < study.results[0].violation <= 1e-2
    assert study.results[0].status == "converged"
    assert study.best is study.results[0]


def test_given_starts_are_checked():
    with refused("start.x1"):
        multistart(waves(), "mmfd", [[0.0, 0.0], [9.0, 0.0]])
    with refused("points"):
        starts_at([])
    with refused("max_lanes", 0):
        multistart(waves(), "mmfd", sobol(4, seed=1), max_lanes=0)


def test_default_is_the_problems_own_start():
    study = multistart(waves())
    alone = optimize(waves())
    assert len(study.results) == 1
    assert study.results[0].value == alone.value


@pytest.mark.parametrize(
    ("starts", "path"),
    [
        (3, "starts"),
        ([[0.0, 0.0], [1.0]], "points"),
        (["a", "b"], "points"),
    ],
)
def test_starts_that_are_none_are_named(starts, path):
    with refused(path):
        multistart(waves(), starts=starts)
    with refused("seed", "x"):
        sobol(2, seed="x")  # pyright: ignore[reportArgumentType]
