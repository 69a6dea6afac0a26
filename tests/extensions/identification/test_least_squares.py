"""One start: failed designs are rejected and counted, limits and interruptions keep the best design."""

from __future__ import annotations

import numpy as np
import pytest

from torchmbd.extensions.identification.fit_problem import Residuals
from torchmbd.extensions.identification.least_squares import FitSettings, fit_start
from torchmbd.extensions.identification.losses import LOSSES

T = np.linspace(0.0, 1.0, 30)
TRUTH = np.array([2.0, 3.0])
DATA = TRUTH[0] * np.exp(-TRUTH[1] * T)


def settings(**changes) -> FitSettings:
    numbers = {
        "lower": np.zeros(2),
        "upper": np.full(2, 10.0),
        "scale": np.ones(2),
        "data": 30,
        "loss": LOSSES["linear"],
    }
    return FitSettings(**{**numbers, "f_scale": 1.0, "tolerance": 1e-10, "max_evaluations": 60, **changes})


def evaluate(X: np.ndarray, gradients: bool) -> list[Residuals]:
    return [curve(*x) for x in X]


def curve(a: float, b: float) -> Residuals:
    y = np.exp(-b * T)
    return Residuals(a * y - DATA, np.stack([y, -a * T * y], 1))


def failing(X: np.ndarray, gradients: bool, least: float = 3.5, most: float = 3.56) -> list[Residuals]:
    """There is no model for b between two limits, where the search goes first."""
    return [
        curve(*x) if not least < x[1] < most else Residuals(np.full(30, np.nan), None, "failed: too stiff") for x in X
    ]


def test_it_converges():
    fit = fit_start(evaluate, np.array([1.0, 1.0]), settings())
    np.testing.assert_allclose(fit.x, TRUTH, rtol=1e-8)
    assert (fit.status, fit.failures) == ("converged", 0)
    assert [step.cost for step in fit.history] == sorted((step.cost for step in fit.history), reverse=True)
    assert fit.history[0].x.tolist() == [1.0, 1.0]


def test_designs_that_fail_are_rejected_and_the_fit_goes_on():
    fit = fit_start(failing, np.array([9.0, 1.0]), settings())
    assert fit.failures > 0
    assert fit.status == "converged"
    np.testing.assert_allclose(fit.x, TRUTH, rtol=1e-8)


def test_a_search_that_designs_without_a_model_stop_is_no_minimum():
    """Its steps become small without a minimum being near."""
    fit = fit_start(
        lambda X, gradients: failing(X, gradients, 3.2, np.inf), np.array([9.0, 1.0]), settings(max_evaluations=200)
    )
    assert fit.status == "stalled"
    assert "the last: failed: too stiff" in fit.message


def test_a_start_that_fails_says_why():
    fit = fit_start(failing, np.array([1.0, 3.55]), settings())
    assert (fit.status, fit.message) == ("failed", "the start: failed: too stiff")
    assert np.isnan(fit.cost)


def test_the_limit_keeps_the_best_design():
    fit = fit_start(evaluate, np.array([1.0, 1.0]), settings(max_evaluations=3))
    assert (fit.status, fit.evaluations) == ("max_evaluations", 3)
    assert fit.cost == min(step.cost for step in fit.history)
    np.testing.assert_array_equal(fit.residuals.values, curve(*fit.x).values)


def test_a_limit_of_time_keeps_the_best_design(monkeypatch):
    """The clock is that of the evaluations."""
    from torchmbd.optimization import search

    count = 0

    def counted(X: np.ndarray, gradients: bool) -> list[Residuals]:
        nonlocal count
        count += 1
        return evaluate(X, gradients)

    monkeypatch.setattr(search.time, "monotonic", lambda: float(count))
    fit = fit_start(counted, np.array([1.0, 1.0]), settings(deadline=2.5))
    assert (fit.status, fit.evaluations) == ("max_time", 3)
    assert fit.cost == min(step.cost for step in fit.history)


def test_an_interruption_keeps_the_best_design():
    count = 0

    def interrupted(X: np.ndarray, gradients: bool) -> list[Residuals]:
        nonlocal count
        count += 1
        if count == 4:
            raise KeyboardInterrupt
        return evaluate(X, gradients)

    fit = fit_start(interrupted, np.array([1.0, 1.0]), settings())
    assert (fit.status, fit.evaluations) == ("interrupted", 3)
    assert fit.cost < fit.history[0].cost


def test_an_unknown_of_equal_bounds_stays():
    fit = fit_start(evaluate, np.array([1.0, 1.0]), settings(lower=np.array([0.0, 1.0]), upper=np.array([10.0, 1.0])))
    y = np.exp(-T)
    assert fit.x[1] == 1.0
    assert fit.x[0] == pytest.approx(float(y @ DATA / (y @ y)))


def test_bounds_hold():
    fit = fit_start(evaluate, np.array([1.0, 1.0]), settings(upper=np.array([1.5, 10.0])))
    assert fit.x[0] == pytest.approx(1.5, rel=1e-4)
