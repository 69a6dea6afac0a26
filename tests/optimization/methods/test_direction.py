"""The direction-finding subproblem in closed form, and the two metrics."""

import numpy as np
import pytest

from torchmbd.optimization import Evaluation
from torchmbd.optimization.methods.direction import VariableMetric, find_direction

FREE = np.full(2, -np.inf), np.full(2, np.inf)


def direction(df, c, dc, B=None, y=None, bounds=FREE, active=None):
    c, dc = np.array(c, dtype=float), np.array(dc, dtype=float).reshape(len(c), 2)
    evaluation = Evaluation(1.0, c, np.array(df, dtype=float), dc)
    active = np.zeros(c.size, dtype=bool) if active is None else np.array(active)
    return find_direction(evaluation, np.zeros(2) if y is None else y, *bounds, np.eye(2) if B is None else B, active)


def test_steepest_descent_where_nothing_is_active():
    assert np.allclose(direction([3, -4], [], []).s, [-3, 4])


def test_follows_an_active_constraint_without_push_off():
    result = direction([-1, -2], [0.0], [[0, 1]], active=[True])
    assert np.allclose(result.s, [1, 0])
    assert result.multipliers == pytest.approx([2.0])


def test_leaves_an_active_constraint_that_does_not_resist():
    result = direction([1, 2], [0.0], [[0, 1]], active=[True])
    assert np.allclose(result.s, [-1, -2])
    assert result.multipliers == pytest.approx([0.0])


def test_a_constraint_ahead_is_met_not_crossed():
    result = direction([-1, -2], [-0.5], [[0, 1]])
    assert np.allclose(result.s, [1, 0.5])


def test_a_violated_constraint_is_restored():
    result = direction([-1, 0], [0.3], [[1, 0]])
    assert np.allclose(result.s, [-0.3, 0])
    assert result.beta == 1.0


def test_side_constraints_hold_exactly():
    result = direction([-5, -5], [], [], y=np.array([0.9, 0.0]), bounds=(np.full(2, -1.0), np.full(2, 1.0)))
    assert np.allclose(result.s, [0.1, 1.0], atol=1e-15)


def test_contradicting_constraints_are_restored_in_part():
    """x <= -1 and x >= 1 from x = 0: each asks for one, none can have it without the other losing as much."""
    result = direction([0, 1], [1.0, 1.0], [[1, 0], [-1, 0]])
    assert result.beta == pytest.approx(0.0, abs=1e-12)
    assert result.s[0] == pytest.approx(0.0, abs=1e-9)


def test_half_of_a_violation_is_removed_where_a_bound_allows_no_more():
    result = direction([0, 0], [2.0], [[1, 0]], bounds=(np.array([-1.0, -9]), np.full(2, 9.0)))
    assert result.beta == pytest.approx(0.5, abs=1e-6)
    assert result.s[0] == pytest.approx(-1.0, abs=1e-6)


def test_bfgs_takes_in_the_curvature_along_the_step():
    metric = VariableMetric(3)
    rng = np.random.default_rng(1)
    H = np.diag([1.0, 4.0, 9.0]) + 0.3
    for _ in range(6):
        s = rng.normal(size=3)
        metric.update(s, H @ s)
        assert np.allclose(metric.B @ s, H @ s)
        assert np.linalg.eigvalsh(metric.B).min() > 0.0


def test_bfgs_stays_positive_definite_where_the_function_is_concave():
    metric = VariableMetric(2)
    rng = np.random.default_rng(2)
    for _ in range(20):
        s = rng.normal(size=2)
        metric.update(s, np.array([[-1.0, 0.2], [0.2, -3.0]]) @ s)
        assert np.linalg.eigvalsh(metric.B).min() > 0.0
