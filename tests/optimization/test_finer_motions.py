"""Searches of problems that get finer: parts, counts, and what follows none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import torchmbd as mbd
from torchmbd.optimization import Evaluation
from torchmbd.optimization.cache import CachedProblem, MemoryStore


class Parabola:
    """(x - 1)^2 with an error of 1 / steps^2 of its place; a design needs 100 steps, beyond 0.9 even 1000."""

    names, start, lower, upper = ["x"], np.array([0.2]), np.array([-2.0]), np.array([2.0])

    def __init__(self, steps: int = 10, seen: list[tuple[int, float]] | None = None):
        self.steps, self.seen = steps, [] if seen is None else seen
        self.coarse: Any = None

    @property
    def accuracy(self) -> str:
        return f"{self.steps} steps"

    def refined(self, x: np.ndarray) -> Parabola | None:
        needed = 1000 if x[0] > 0.9 else 100
        return Parabola(needed, self.seen) if needed > self.steps else None

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        self.seen += [(self.steps, float(x)) for x in X[:, 0]]
        shift = 1.0 + 1.0 / self.steps**2
        none = np.zeros(0)
        return [
            Evaluation(float((x - shift) ** 2), none, 2.0 * (X[k] - shift), np.zeros((0, 1))) for k, [x] in enumerate(X)
        ]


def test_a_search_ends_with_the_problem_that_its_design_needs():
    problem, reports = Parabola(), []
    result = mbd.optimize(problem, "slsqp", max_iterations=30, callback=reports.append)
    assert result.status == "converged"
    assert result.x[0] == pytest.approx(1.0 + 1e-6, abs=1e-9)
    assert getattr(result.problem, "steps", None) == 1000
    assert result.analyses == len(problem.seen)
    assert [one.iteration for one in result.history] == list(range(result.iterations + 1))
    assert [one.iteration for one in reports] == [one.iteration for one in result.history]


def of_start(steps: int, x: float = 0.2) -> float:
    """The objective of a start by so many steps."""
    return (x - 1.0 - 1.0 / steps**2) ** 2


@pytest.mark.parametrize("door", ["optimize", "multistart", "stored"])
def test_one_rule_for_all_doors(door: str) -> None:
    """The start and the result of every search are by the last steps, and each entry of a history says by which."""
    problem, ended, reports = Parabola(100), [], []
    problem.coarse = Parabola(10, problem.seen)
    if door == "optimize":
        results = [mbd.optimize(problem, "slsqp", max_iterations=30, callback=reports.append)]
    else:
        target: Any = problem
        if door == "stored":
            target = CachedProblem(problem, MemoryStore(), others=lambda other: (MemoryStore(), other))
        starts = [[0.2], [-1.5]]
        study = mbd.optimization.multistart(target, "slsqp", starts, reports.append, ended.append, max_iterations=30)
        results = study.results
        assert [result.start for result in ended] == [0, 1]
        assert all(a is b for a, b in zip(ended, results, strict=True))
        assert len(study.minima) == 1
    for result, x in zip(results, (0.2, -1.5), strict=False):
        assert result.status == "converged"
        assert result.x[0] == pytest.approx(1.0 + 1e-6, abs=1e-9)
        assert result.history[0].objective == pytest.approx(of_start(1000, x), rel=1e-12)
        assert result.history[0].accuracy == result.history[-1].accuracy == result.problem.accuracy == "1000 steps"
        assert {entry.accuracy for entry in result.history} <= {"10 steps", "1000 steps"}
        assert [entry.iteration for entry in result.history] == list(range(result.iterations + 1))
        own = [entry.iteration for entry in reports if entry.start == result.start]
        assert own == list(range(result.iterations + 1))
        assert "better than the start" in repr(result)


def test_an_interruption_ends_all_parts() -> None:
    problem = Parabola(100)
    problem.coarse = Parabola(10, problem.seen)

    def stop(iterate: Any) -> None:
        raise KeyboardInterrupt

    result = mbd.optimize(problem, "slsqp", max_iterations=30, callback=stop)
    assert result.status == "interrupted"
    assert {n for n, _ in problem.seen} == {10}


def test_a_coarse_problem_takes_half_of_the_iterations_at_most():
    problem = Parabola(100)
    problem.coarse = Parabola(10, problem.seen)
    mbd.optimize(problem, "slsqp", max_iterations=30)
    steps = [n for n, _ in problem.seen]
    assert steps == sorted(steps)
    assert set(steps) == {10, 1000}


def test_limits_that_end_before():
    problem = Parabola()
    result = mbd.optimize(problem, "mmfd", max_iterations=1)
    assert "left no iteration by the finer motions" in result.message
    assert {n for n, _ in problem.seen} == {10, 100}
    assert result.value == pytest.approx((result.x[0] - 1.0 - 1e-4) ** 2, abs=1e-12)
    assert mbd.optimize(Parabola(), "mmfd", max_iterations=30, max_analyses=3).analyses <= 5


def test_wrappers_are_searched_as_they_are():
    """What they keep of evaluations would miss those of another problem."""

    class Wrapper:
        def __init__(self, inner: Parabola):
            self.inner = inner

        def __getattr__(self, name: str) -> Any:
            return getattr(self.inner, name)

    inner = Parabola()
    mbd.optimize(Wrapper(inner), "slsqp", max_iterations=10)
    assert {n for n, _ in inner.seen} == {10}
