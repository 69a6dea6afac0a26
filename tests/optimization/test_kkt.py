"""Multipliers of a design: the least squares of constraints and bounds together, whatever their number."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from torchmbd.optimization.kkt import kuhn_tucker
from torchmbd.optimization.optimizer import Evaluation

BAND = 1e-6


def least_length(evaluation: Evaluation, y: np.ndarray, equality: np.ndarray) -> float:
    """|df + sum_i lambda_i dc_i + nu|, least over lambda and nu as columns of one matrix; bounds are -1 and 1."""
    df, dc, c = evaluation.objective_gradient, evaluation.constraint_gradients, evaluation.constraints
    assert df is not None
    assert dc is not None
    identity = np.eye(y.size)
    columns = [dc[(c >= -BAND) | equality], -dc[equality], identity[y == 1.0], -identity[y == -1.0]]
    A = np.vstack(columns).T
    return float(nnls(A, -df)[1]) if A.size else float(np.linalg.norm(df))


@pytest.mark.thorough
def test_constraints_and_bounds_take_what_they_can():
    """Random designs, some of them optimal, with several constraints and bounds that are active."""
    rng = np.random.default_rng(3)
    for case in range(600):
        n, m = int(rng.integers(1, 12)), int(rng.integers(0, 8))
        y = np.clip(1.5 * rng.normal(size=n), -1.0, 1.0)
        dc, df = rng.normal(size=(m, n)), rng.normal(size=n)
        c = np.where(rng.random(m) < 0.6, 0.0, -0.1 - rng.random(m))
        equality = (rng.random(m) < 0.2) & (c == 0.0)
        if case % 3 == 0:
            df = np.where(y == 1.0, -rng.random(n), 0.0) + np.where(y == -1.0, rng.random(n), 0.0)
            df -= dc[c == 0.0].T @ rng.random(int((c == 0.0).sum()))
        evaluation = Evaluation(1.0, c, df, dc)
        quality = kuhn_tucker(evaluation, y, -np.ones(n), np.ones(n), equality)
        remainder = df + dc.T @ quality.multipliers + quality.bound_multipliers
        assert np.linalg.norm(remainder) == pytest.approx(least_length(evaluation, y, equality), abs=1e-9)
        assert (quality.multipliers[~equality] >= 0.0).all()
        assert (quality.bound_multipliers * y >= 0.0).all()
        assert not quality.bound_multipliers[np.abs(y) < 1.0].any()
        if case % 3 == 0:
            assert quality.residual < 1e-9


def test_many_variables_at_bounds():
    """Without a matrix of n x n numbers, of 80 GB."""
    n = 100_000
    df, y = np.where(np.arange(n) % 2, 1.0, -1.0), np.where(np.arange(n) % 2, -1.0, 1.0)
    evaluation = Evaluation(1.0, np.zeros(1), df + 0.5, -np.ones((1, n)))
    quality = kuhn_tucker(evaluation, y, -np.ones(n), np.ones(n), np.zeros(1, dtype=bool))
    assert quality.residual < 1e-12
