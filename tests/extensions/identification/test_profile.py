"""Profile likelihoods: the linearized interval of a linear problem, and a skew one of a curved problem."""

from __future__ import annotations

import numpy as np
import pytest

from torchmbd.extensions.identification.fit_problem import Residuals
from torchmbd.extensions.identification.least_squares import FitSettings, fit_start
from torchmbd.extensions.identification.losses import LOSSES
from torchmbd.extensions.identification.profile import profile_interval

T = np.linspace(0.0, 1.0, 20)
DATA = 2.0 + 3.0 * T


def settings(lower=(-np.inf, -np.inf)) -> FitSettings:
    return FitSettings(np.array(lower), np.full(2, np.inf), np.ones(2), 20, LOSSES["linear"], 1.0, 1e-12, 60)


def line(X: np.ndarray, gradients: bool) -> list[Residuals]:
    return [Residuals((a + b * T - DATA) / 0.1, np.stack([np.ones(20), T], 1) / 0.1) for a, b in X]


def test_of_a_linear_problem_it_is_the_linear_interval():
    fit = fit_start(line, np.zeros(2), settings())
    J = fit.residuals.jacobian
    assert J is not None
    deviation = float(np.sqrt(np.linalg.inv(J.T @ J)[1, 1]))
    ends = profile_interval(line, settings(), fit, 1, 2.1, deviation, 1.0)
    np.testing.assert_allclose(ends, [3.0 - 2.1 * deviation, 3.0 + 2.1 * deviation], rtol=1e-3)


def test_bounds_end_it():
    fit = fit_start(line, np.array([0.0, 3.5]), settings((-np.inf, 2.95)))
    low, high = profile_interval(line, settings((-np.inf, 2.95)), fit, 1, 2.1, 0.07, 1.0)
    assert low == 2.95
    assert high > 3.05


def test_of_a_curved_problem_it_is_where_the_likelihood_says():
    """One number 1/b = 2 of deviation 0.2: the interval of b is that of its inverse; the other unknown is idle."""

    def inverse(X: np.ndarray, gradients: bool) -> list[Residuals]:
        return [
            Residuals(np.array([(1.0 / b - 2.0) / 0.2, a]), np.array([[0.0, -5.0 / b**2], [1.0, 0.0]])) for a, b in X
        ]

    limits = FitSettings(np.array([-9.0, 1e-3]), np.full(2, 9.0), np.ones(2), 2, LOSSES["linear"], 1.0, 1e-12, 60)
    fit = fit_start(inverse, np.array([0.0, 0.6]), limits)
    ends = profile_interval(inverse, limits, fit, 1, 2.0, 0.05, 1.0)
    np.testing.assert_allclose(ends, [1.0 / 2.4, 1.0 / 1.6], atol=2e-3)
    assert ends[1] - 0.5 > 1.2 * (0.5 - ends[0])


@pytest.mark.parametrize("index", [0])
def test_what_is_not_seen_has_no_end(index):
    def idle(X: np.ndarray, gradients: bool) -> list[Residuals]:
        return [Residuals((b * T - DATA) / 0.1, np.stack([0.0 * T, T], 1) / 0.1) for a, b in X]

    fit = fit_start(idle, np.ones(2), settings())
    assert profile_interval(idle, settings(), fit, index, 2.0, np.inf, 1.0) == (-np.inf, np.inf)
