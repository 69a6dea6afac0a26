"""The comparison of methods counts what it says: arrivals, also of corrected ends, and starts that never arrive."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.benchmark import methods as benchmark
from experiments.benchmark.report import Settings
from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize
from torchmbd.optimization.optimizer import Iterate, OptimizationResult


def ended(history: list[tuple[float, float, int]], value: float, violation: float, analyses: int) -> OptimizationResult:
    """A result with accepted designs of (objective, violation, analyses)."""
    none = np.zeros(0)
    iterates = [
        Iterate(0, k, none, objective, violated, none, count) for k, (objective, violated, count) in enumerate(history)
    ]
    return OptimizationResult(
        x=none,
        value=value,
        constraints=none,
        violation=violation,
        status="stalled",
        message="",
        method="slsqp",
        iterations=len(history) - 1,
        analyses=analyses,
        gradient_evaluations=analyses,
        failures=0,
        history=iterates,
        multipliers=none,
        bound_multipliers=none,
        kkt_residual=0.0,
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])  # of what is maximized the negative is minimized
def test_arrivals_are_those_of_feasible_designs_near_the_optimum(sign):
    far, near, below = (sign * 2.0 * x for x in (1.0 + 0.03 * sign, 1.0 + 0.005 * sign, 1.0 - 0.1 * sign))
    optimum = sign * 2.0
    assert benchmark.arrival(ended([(far, 0.0, 1), (below, 0.2, 3), (near, 0.0, 6)], optimum, 0.0, 9), optimum) == 6
    assert benchmark.arrival(ended([(far, 0.0, 1), (below, 0.2, 3)], near, 0.0, 9), optimum) == 9  # a corrected end
    assert benchmark.arrival(ended([(far, 0.0, 1), (below, 0.2, 3)], below, 0.2, 9), optimum) is None


def test_methods_are_compared_from_equal_starts(monkeypatch):
    """A bowl with its minimum 1 at a bound; all starts of all methods arrive, within the limit of simulations."""
    bowl = Analytic("bowl", [2.0, 2.0], lambda x: 1.0 + (x[0] - 1.0) + x[1] ** 2, lower=[1.0, -3.0], upper=[3.0, 3.0])
    monkeypatch.setattr(benchmark, "CASES", {"bowl": benchmark.Case(lambda: bowl, lambda problem: 1.0)})
    result = benchmark.methods(Settings(methods=["slsqp", "mmfd"]))
    assert set(result.figures) == {"bowl: slsqp", "bowl: mmfd"}
    for simulations, share, failures in result.figures.values():
        assert 1 <= simulations <= benchmark.ANALYSES
        assert (share, failures) == (1.0, 0)
    rows, summary = result.tables
    assert [row[:4] for row in rows.rows] == [["bowl", pytest.approx(1.0), 1.0, name] for name in ("slsqp", "mmfd")]
    assert [row[:2] for row in summary.rows] == [["slsqp", "100%"], ["mmfd", "100%"]]
    alone = optimize(bowl, "slsqp", progress=False)
    assert benchmark.least_value([alone]) == pytest.approx(1.0)


def test_problems_have_parts_of_the_models_and_of_the_paper():
    assert len(benchmark.CASES) == 10
    assert all(case.problem().names for name, case in benchmark.CASES.items() if name.startswith("slider_crank"))
