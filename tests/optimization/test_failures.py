"""Failed evaluations: counted by reason, and a status of their own where they are many."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import torchmbd as mbd
from torchmbd.optimization import Evaluation, MultistartResult
from torchmbd.optimization.failures import are_many, counted, failures_text


class Valley:
    """(x - 1)^2 from x = 0, of which designs beyond `edge` fail, each at a time of its own."""

    names, start, lower, upper = ["x"], np.array([0.0]), np.array([-2.0]), np.array([2.0])

    def __init__(self, edge: float):
        self.edge = edge

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        return [
            Evaluation.failure(f"failed: no state at t = {x:.4f} s")
            if x > self.edge
            else Evaluation(float((x - 1.0) ** 2), np.zeros(0), np.array([2.0 * (x - 1.0)]), np.zeros((0, 1)))
            for [x] in X
        ]


def test_reasons_that_differ_in_numbers_are_one() -> None:
    reasons = counted([("at t = 0.1 s", 2), ("no state", 3), ("at t = 2e-3 s", 4)])
    assert reasons == {"at t = 0.1 s": 6, "no state": 3}
    assert list(reasons) == ["at t = 0.1 s", "no state"]
    assert failures_text(20, reasons) == "9 of 20 evaluations failed, 6 of them: at t = 0.1 s"
    assert failures_text(20, {}) == "20 evaluations, none failed"
    assert not are_many(10, {"a": 1})
    assert are_many(9, {"a": 1})


@pytest.mark.parametrize("search", [mbd.optimize, mbd.optimization.multistart])
def test_a_result_tells_failures_and_the_start(search: Any) -> None:
    sound, failing = search(Valley(3.0), "slsqp"), search(Valley(0.5), "slsqp")
    text = repr(sound)
    assert "converged" in text
    assert "none failed" in text
    assert "better than the start (objective 1)" in text
    assert not sound.failing_text
    best = failing.best if search is mbd.optimization.multistart else failing
    assert best.status == "many_failures"
    assert not best.converged
    assert sum(best.reasons.values()) == best.failures
    assert len(best.reasons) == 1
    for told in (repr(failing), failing.search_text):
        assert f"{best.failures} of {best.analyses} evaluations failed, all of them: no state at t = " in told
        assert "better than the start (objective 1)" in told
    assert failing.failing_text


class Wall(Valley):
    """The valley left of x = `limit`."""

    def __init__(self, limit: float):
        super().__init__(3.0)
        self.limit = limit

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        slope = np.ones((1, 1))
        return [
            Evaluation(float((x - 1.0) ** 2), np.array([x - self.limit]), np.array([2.0 * (x - 1.0)]), slope)
            for [x] in X
        ]


@pytest.mark.parametrize(
    ("limit", "begin", "text"),
    [
        (-1.0, 0.0, "feasible, unlike the start (objective 1, violation 1)"),  # its objective, 4, is larger
        (0.5, 0.0, "better than the start (objective 1)"),
        (-3.0, 0.0, "less infeasible than the start (objective 1, violation 3)"),  # the bound is -2
    ],
)
def test_a_feasible_design_is_better_than_an_infeasible_start(limit: float, begin: float, text: str) -> None:
    assert mbd.optimize(Wall(limit), "slsqp", start=np.array([begin])).gain_text == text


def test_a_search_without_an_evaluation_has_no_design() -> None:
    assert "no design was evaluated; 0 evaluations" in MultistartResult([], []).search_text
    assert "no start ended with a feasible design" in mbd.optimization.multistart(Wall(-3.0), "slsqp").search_text


def test_an_optimum_at_the_start_is_equal_to_it() -> None:
    problem = Valley(3.0)
    result = mbd.optimize(problem, "slsqp", start=np.array([1.0]))
    assert "equal to the start" in repr(result)
    at_bound = mbd.optimize(problem, "slsqp", start=np.array([1.0]), max_iterations=3)
    assert at_bound.active == []


def test_active_bounds_are_told() -> None:
    problem = Valley(3.0)
    problem.upper = np.array([0.5])
    result = mbd.optimize(problem, "slsqp")
    assert result.active == ["upper bound of x"]
    assert "upper bound of x" in repr(result)
