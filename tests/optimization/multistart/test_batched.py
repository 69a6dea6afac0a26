"""Groups of starts on a problem that evaluates several batches at once: the same results, none waits, all can be stopped."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import sobol
from torchmbd.optimization.multistart import multistart


class Elsewhere:
    """A problem that threads evaluate, `parallel_batches` batches in parallel; a batch of design k takes `seconds(k)`."""

    def __init__(self, problem, parallel_batches, seconds=lambda X: 0.0):
        self.problem, self.parallel_batches, self.seconds = problem, parallel_batches, seconds
        self.pool = ThreadPoolExecutor(parallel_batches)
        self.began, self.cancelled = [], []

    def __getattr__(self, name):
        return getattr(self.problem, name)

    def begin(self, X, gradients, among):
        self.began.append((len(X), among))
        return Later(self, self.pool.submit(self._evaluate, X, gradients))

    def _evaluate(self, X, gradients):
        time.sleep(self.seconds(X))
        return self.problem.evaluate(X, gradients)


class Later:
    def __init__(self, problem, future):
        self.problem, self.future = problem, future

    @property
    def done(self):
        return self.future.done()

    def notify(self, call):
        self.future.add_done_callback(lambda _: call())

    def evaluations(self):
        return self.future.result()

    def cancel(self):
        self.problem.cancelled.append(self.future)


def valley(**changes) -> Analytic:
    return Analytic(
        "valley",
        [2.5, 3.0],
        lambda x: (1 - x[0]) ** 2 + 3 * (x[1] - x[0] ** 2) ** 2,
        lambda x: [x[0] ** 2 / 30 + x[1] / 9 - 1],
        **({"lower": -3.0, "upper": 4.0} | changes),
    )


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["mmfd", "slsqp"])
def test_groups_end_as_one_batch_does(method):
    starts = sobol(11, seed=3)
    alone = multistart(valley(), method, starts)
    grouped = multistart(Elsewhere(valley(), 3), method, starts, max_lanes=7)
    assert [r.start for r in grouped.results] == list(range(11))
    for one, other in zip(alone.results, grouped.results, strict=True):
        assert np.array_equal(one.x, other.x)
        assert [i.objective for i in one.history] == [i.objective for i in other.history]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("lanes", "groups", "width"),
    [
        (7, 6, 2),  # starts enough for a second batch beside each of the three that are evaluated
        (15, 4, 3),  # of five lanes each: four groups find starts for half of them, five would not
        (36, 3, 4),
    ],
)
def test_lanes_are_shared_out(lanes, groups, width):
    problem = Elsewhere(valley(), 3)
    multistart(problem, "mmfd", sobol(12, seed=3), max_lanes=lanes)
    assert problem.began[:groups] == [(width, groups)] * groups
    assert max(size for size, _ in problem.began) <= lanes // 3


@pytest.mark.thorough
def test_no_group_waits_for_another():
    """The first start's batches are slow: the others are through before."""
    first = sobol(4, seed=3).points(valley())[0]
    slow = Elsewhere(valley(), 2, lambda X: 0.1 if np.abs(X - first).max(1).min() < 1e-12 else 0.0)
    ends = []
    multistart(slow, "slsqp", sobol(4, seed=3), ended=lambda r: ends.append(r.start), max_lanes=4)
    assert ends[-1] == 0


@pytest.mark.thorough
def test_one_group_where_the_number_of_starts_depends_on_results():
    problem = Elsewhere(valley(), 3)
    multistart(problem, "mmfd", sobol(12, seed=3), max_lanes=6, minima_left=0.5)
    assert {among for _, among in problem.began} == {1}


@pytest.mark.thorough
def test_an_error_and_an_interrupt_stop_all_groups():
    for error in (ZeroDivisionError, KeyboardInterrupt):
        problem = Elsewhere(valley(), 2, lambda X: 0.05)

        def callback(iterate, error=error):
            if iterate.iteration == 1:
                raise error

        before = threading.active_count()
        if error is KeyboardInterrupt:
            study = multistart(problem, "mmfd", sobol(6, seed=3), callback)
            assert study.interrupted
            assert [r.status for r in study.results] == ["interrupted"] * 6
        else:
            with pytest.raises(ZeroDivisionError):
                multistart(problem, "mmfd", sobol(6, seed=3), callback)
        assert problem.cancelled
        problem.pool.shutdown()
        assert threading.active_count() <= before


def test_an_error_of_a_worker_is_raised_here():
    problem = Elsewhere(valley(), 2)
    problem._evaluate = lambda X, gradients: 1 / 0
    with pytest.raises(ZeroDivisionError):
        multistart(problem, "mmfd", sobol(6, seed=3))
