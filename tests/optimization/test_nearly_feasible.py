"""Ends of a search between a far feasible design and a better one that violates a constraint by little."""

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import OPTIMIZERS, optimize
from torchmbd.optimization.nearly_feasible import CORRECTIONS
from torchmbd.optimization.optimizer import Ending


def wall(unit: float = 1.0, shift: float = 0.0) -> Analytic:
    """min x0 + 0.1 x1^2 where x0 (1 + 0.2 cos x1) >= 1.2: 1 at (1, 0), from a feasible start of 3."""
    return Analytic(
        "wall",
        [3.0, 1.0],
        lambda x: unit * (x[0] + 0.1 * x[1] ** 2 + shift),
        lambda x: [1.0 - x[0] * (1.0 + 0.2 * np.cos(x[1])) / 1.2],
        lower=[0.1, -1.5],
        upper=[5.0, 1.5],
    )


def stopping_at(designs, status: str = "max_iterations"):
    """A method that evaluates designs one after another and ends at the last."""

    def method(search, max_iterations: int, *, kkt: float = 1e-3) -> Ending:
        search.begin()
        for x in designs:
            y = np.asarray(x) / search.scale
            search.evaluate(y)
            search.record(y)
        return Ending(search.start if status == "stalled" else y, status, "that was all")

    return method


@pytest.mark.parametrize("status", ["max_iterations", "stalled", "infeasible"])
@pytest.mark.parametrize("violation", [2e-6, 1e-4, 9e-3])
def test_a_nearly_feasible_design_is_corrected(monkeypatch, status, violation):
    monkeypatch.setitem(OPTIMIZERS, "short", stopping_at([(1.0 - violation, 0.02)], status))
    problem = wall()
    result = optimize(problem, "short", max_iterations=1)
    assert result.violation <= 1e-6
    assert result.value == pytest.approx(1.0, rel=2e-3)
    assert problem.functions <= 2 + CORRECTIONS
    assert "a nearly feasible design was corrected" in result.message or status == "infeasible"
    assert problem.evaluate(result.x[None], False)[0].objective == result.value


def test_the_least_violated_design_is_corrected_among_similar_promises(monkeypatch):
    monkeypatch.setitem(OPTIMIZERS, "short", stopping_at([(0.99, 0.3), (0.9999, 0.01), (0.992, -0.2)]))
    problem = wall()
    result = optimize(problem, "short", max_iterations=1)
    assert result.x == pytest.approx([1.0, 0.01], abs=2e-3)
    assert problem.functions <= 5


def test_nothing_is_simulated_where_nothing_is_gained(monkeypatch):
    monkeypatch.setitem(OPTIMIZERS, "short", stopping_at([(1.0, 0.0), (0.9999, 0.0)]))
    problem = wall()
    result = optimize(problem, "short", max_iterations=1)
    assert problem.functions == 3
    assert result.x == pytest.approx([1.0, 0.0])


def test_a_limit_of_analyses_tells_the_better_design(monkeypatch):
    monkeypatch.setitem(OPTIMIZERS, "short", stopping_at([(0.999, 0.0)]))
    result = optimize(wall(), "short", max_analyses=2)
    assert result.analyses == 2
    assert result.value == pytest.approx(3.1)  # the start
    assert "a design of 0.999 violates a constraint by only 0.001. Try: more iterations" in result.message


def test_a_contradiction_is_not_corrected(monkeypatch):
    monkeypatch.setitem(OPTIMIZERS, "short", stopping_at([(0.501, 0.0)], "infeasible"))
    problem = Analytic("gap", [2.0, 0.0], lambda x: x[0], lambda x: [0.505 - x[0], x[0] - 0.495], lower=-3, upper=3)
    result = optimize(problem, "short", max_iterations=1)
    assert result.status == "infeasible"
    assert result.violation == pytest.approx(0.005, abs=1e-6)
    assert "conflict" in result.message


def test_a_kuhn_tucker_point_has_converged_whatever_the_method_says(monkeypatch):
    monkeypatch.setitem(OPTIMIZERS, "short", stopping_at([(1.0, 0.0)], "stalled"))
    result = optimize(wall(), "short", max_iterations=1)
    assert result.status == "converged"
    assert result.message.startswith("the Kuhn-Tucker conditions hold (that was all)")


@pytest.mark.parametrize(("unit", "shift"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 5.0)])
def test_units_of_the_objective_do_not_matter(monkeypatch, unit, shift):
    monkeypatch.setitem(OPTIMIZERS, "short", stopping_at([(0.9999, 0.02)]))
    plain, other = optimize(wall(), "short"), optimize(wall(unit, shift), "short")
    assert np.allclose(other.x, plain.x, rtol=1e-9)
