"""A limit of time: no evaluation begins after it; what is done by then is the result. The clock counts evaluations."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.optimization.analytic import Analytic
from tests.refused import refused
from torchmbd.optimization import search
from torchmbd.optimization.optimizer import STATUSES


class Clock:
    """Seconds that pass with the evaluations of a problem: one for each batch."""

    def __init__(self, problem: Analytic):
        self.problem = problem

    def monotonic(self) -> float:
        return float(len(self.problem.batches))


def rosenbrock() -> Analytic:
    return Analytic("rosenbrock", [-1.2, 1.0], lambda x: 100.0 * (x[1] - x[0] ** 2) ** 2 + (1.0 - x[0]) ** 2)


@pytest.fixture
def problem(monkeypatch) -> Analytic:
    result = rosenbrock()
    monkeypatch.setattr(search, "time", Clock(result))
    return result


@pytest.mark.parametrize("method", ["mmfd", "sqcqp", "slsqp", "lbfgs", "trust-constr", "mma"])
def test_the_best_design_by_then_is_the_result(problem, method):
    result = mbd.optimize(problem, method, max_time=4.5)
    assert result.status == "max_time"
    assert result.status in STATUSES
    assert "limit of time" in result.message
    assert len(problem.batches) == 5
    assert result.value < result.history[0].objective
    unlimited = mbd.optimize(rosenbrock(), method)
    assert unlimited.value < result.value


def test_enough_time_changes_nothing(problem):
    result, other = mbd.optimize(problem, "slsqp", max_time=1e6), mbd.optimize(rosenbrock(), "slsqp")
    assert (result.status, result.value) == (other.status, other.value)


def test_a_multistart_begins_no_start_after_it(problem):
    problem.lower[:], problem.upper[:] = -2.0, 2.0
    study = mbd.optimization.multistart(problem, "slsqp", mbd.optimization.sobol(8, seed=1), max_lanes=2, max_time=5.5)
    assert len(problem.batches) <= 7
    assert {r.status for r in study.results} == {"max_time"}
    assert study.best is not None
    assert np.isfinite(study.best.value)
    assert study.stopped_early


@pytest.mark.parametrize("limit", [0.0, -1.0, "long", np.nan])
@pytest.mark.parametrize("function", [mbd.optimize, mbd.optimization.multistart])
def test_a_limit_is_positive(function, limit):
    with refused("max_time"):
        function(rosenbrock(), max_time=limit)
