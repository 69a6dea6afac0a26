"""Covariances, intervals and whiteness, against closed forms and random draws."""

from __future__ import annotations

import numpy as np
import pytest

from torchmbd.extensions.identification.losses import LOSSES
from torchmbd.extensions.identification.statistics import (
    correlations,
    covariance,
    half_widths,
    ljung_box,
    quantile,
    runs_test,
    variance_factor,
)

RNG = np.random.default_rng(3)


def test_the_covariance_of_a_straight_line():
    t = np.linspace(0.0, 1.0, 21)
    J = np.stack([np.ones(21), t], 1) / 0.1
    expected = np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(covariance(J, np.array([3.0, 0.2]), 1.0), expected)
    c = correlations(expected)
    np.testing.assert_allclose(np.diag(c), 1.0)
    assert c[0, 1] == pytest.approx(-t.mean() / np.sqrt((t**2).mean()))


def test_unknowns_in_an_unseen_direction_have_no_interval():
    J = np.stack([T := np.linspace(1.0, 2.0, 9), T, np.ones(9)], 1)
    J = 100.0 * J
    cov = covariance(J, np.ones(3), 1.0)
    assert np.isinf(np.diag(cov)[:2]).all()
    alone = 100.0 * np.stack([T, np.ones(9)], 1)
    assert cov[2, 2] == pytest.approx(np.linalg.inv(alone.T @ alone)[1, 1])


def test_a_direction_below_the_noise_is_not_held():
    """It is nearly that of the second unknown; what it adds to the first is part of its deviation."""
    T = np.linspace(1.0, 2.0, 9)
    J = np.stack([20.0 * T, 0.1 * (T + 0.3 * T**2)], 1)
    cov = covariance(J, np.ones(2), 1.0)
    assert np.isinf(cov[1, 1])
    assert cov[0, 0] == pytest.approx(np.linalg.inv(J.T @ J)[0, 0])


def test_half_widths_of_a_sum_are_banerjees():
    """A sum of the means of two groups of 3 and of 5 numbers."""
    s, n = np.array([2.0, 0.5]), np.array([3, 5])
    moves = np.concatenate([np.full(k, x / k) for x, k in zip(s, n, strict=True)])[None]
    expected = np.sqrt(quantile(2) ** 2 * s[0] ** 2 / 3 + quantile(4) ** 2 * s[1] ** 2 / 5)
    assert half_widths(moves, [(slice(0, 3), 2.0), (slice(3, 8), 4.0)], 0.95)[0] == pytest.approx(expected)
    known = quantile(np.inf) * np.sqrt((s**2 / n).sum())
    assert half_widths(moves, [], 0.95)[0] == pytest.approx(known)


def test_the_factor_of_a_robust_loss_is_that_of_its_draws():
    """The location of normal numbers by Huber's loss: variance over many draws."""
    scale, count = 0.8, 60
    rho = LOSSES["huber"]
    centers, factors = [], []
    for _ in range(400):
        x, center = RNG.standard_normal(count), 0.0
        for _ in range(30):
            r = center - x
            weight = rho((r / scale) ** 2)[1]
            center -= float((weight * r).sum() / weight.sum())
        centers.append(center)
        factors.append(variance_factor(center - x, count, 1, rho, scale))
    assert np.mean(factors) / count == pytest.approx(np.var(centers), rel=0.15)


def test_students_quantiles():
    assert quantile(10) == pytest.approx(2.2281, abs=1e-4)
    assert quantile(100_000) == pytest.approx(1.96, abs=1e-3)
    assert (quantile(np.inf), quantile(0.0)) == (pytest.approx(1.959964), np.inf)


@pytest.mark.parametrize("test", [ljung_box, runs_test])
def test_probabilities_of_white_noise_are_even(test):
    p = np.array([test(RNG.standard_normal(200)) for _ in range(400)])
    assert abs((p < 0.1).mean() - 0.1) < 0.05
    assert abs((p < 0.5).mean() - 0.5) < 0.1
    assert test(np.sin(np.linspace(0.0, 6.0, 200)) + 0.1 * RNG.standard_normal(200)) < 1e-6
    assert np.isnan(test(np.ones(5)))
