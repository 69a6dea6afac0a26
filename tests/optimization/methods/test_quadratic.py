"""The quadratic program: its optimality conditions on random problems, and contradictions as linear programming sees them."""

import numpy as np
import pytest
from scipy.optimize import linprog

from torchmbd.optimization.methods.quadratic import solve_quadratic


def draw(seed: int):
    """A random problem: metrics from soft to stiff, repeated rows, active and idle rows; every third one is pinched."""
    rng = np.random.default_rng(seed)
    n, m = rng.integers(1, 8), rng.integers(1, 16)
    R = rng.normal(size=(n, n))
    B = R @ R.T + 10.0 ** rng.uniform(-4, 1) * np.eye(n)
    c = rng.normal(size=n) * 10.0 ** rng.uniform(-3, 3)
    A = rng.normal(size=(m, n))
    if rng.random() < 0.5:
        A = np.vstack([A, np.eye(n), -np.eye(n), A[:2]])
    b = A @ rng.normal(size=n) + np.where(rng.random(len(A)) < 0.4, 0.0, rng.random(len(A)))
    return B, c, A, b - (2.0 if seed % 3 == 2 else 0.0)


@pytest.mark.parametrize("seed", range(150))
def test_optimality_or_contradiction(seed):
    B, c, A, b = draw(seed)
    solution = solve_quadratic(B, c, A, b)
    feasible = linprog(np.zeros(c.size), A, b, bounds=(None, None)).status == 0
    assert (solution is not None) == feasible
    if solution is None:
        return
    s, u = solution.s, solution.multipliers
    size = max(1.0, np.abs(c).max())
    assert np.abs(B @ s + c + A.T @ u).max() <= 1e-8 * size
    assert (A @ s - b).max() <= 1e-9 * (1.0 + np.abs(b).max())
    assert u.min() >= 0.0
    assert np.abs(u * (A @ s - b)).max() <= 1e-7 * max(1.0, u.max())


def test_active_rows_are_met_to_the_last_digit_where_the_metric_is_soft():
    """The unconstrained minimum lies 1e9 away: the step back must not lose nine digits."""
    B, c = 1e-9 * np.eye(2), np.array([1.0, 0.3])
    A, b = np.array([[-1e6, 2e6], [-1.0, -1.0]]), np.array([3e-6, 1e-6])
    s = solve_quadratic(B, c, A, b).s
    assert np.abs(A @ s - b).max() <= 1e-15
