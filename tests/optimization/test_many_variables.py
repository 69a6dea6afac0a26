"""Thousands of variables: methods with matrices of n x n numbers are refused at the door, others serve."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.optimization.optimizer import DENSE, MOST_DENSE, OPTIMIZERS, Evaluation

N = 100_000


class Valley:
    """minimize sum (x - target)^2 / n   subject to   mean x <= 0.2"""

    def __init__(self, n: int = N) -> None:
        self.names = [f"x[{k}]" for k in range(n)]
        self.start, self.lower, self.upper = np.zeros(n), -np.ones(n), np.ones(n)
        self.target = np.linspace(-2.0, 2.0, n)

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        n = X.shape[1]
        df, dc = 2.0 * (X - self.target) / n, np.full((1, n), 1.0 / n)
        values = np.square(X - self.target).mean(1)
        rows = zip(values, X, df, strict=True)
        if not gradients:
            return [Evaluation(float(f), np.array([x.mean() - 0.2])) for f, x, _ in rows]
        return [Evaluation(float(f), np.array([x.mean() - 0.2]), g, dc) for f, x, g in rows]


@pytest.mark.thorough
@pytest.mark.parametrize("method", sorted(DENSE))
def test_a_method_with_dense_matrices_is_refused(method):
    text = rf"method = '{method}' has 100,000 design variables: must have at most 5,000.*Try: method = .*lbfgs"
    problem = Valley()
    for search in (
        lambda: mbd.optimize(problem, method),
        lambda: mbd.optimization.multistart(problem, method, [problem.start]),
        lambda: mbd.optimization.optimize_discrete(problem, 0.5, method),
        lambda: mbd.Study(problem, method=method),
    ):
        with pytest.raises(mbd.InputError, match=text):
            search()


def test_which_methods_are_dense():
    assert set(OPTIMIZERS) > DENSE == {"auto", "sqcqp", "mmfd", "slsqp", "trust-constr", "differential_evolution"}


@pytest.mark.thorough
def test_another_method_serves():
    """Half of the variables end at a bound."""
    result = mbd.optimize(Valley(), "lbfgs", max_iterations=30)
    assert result.converged, result.message
    np.testing.assert_allclose(result.x, np.clip(Valley().target, -1.0, 1.0), atol=1e-4)


@pytest.mark.thorough
def test_designs_that_are_moved_one_by_one_are_refused():
    for argument, make in (
        ("problem", mbd.Differences),
        ("tolerance", lambda problem: mbd.optimization.RobustProblem(problem, 0.1)),
    ):
        with refused(argument, ANY, "5,000", "100,000"):
            make(Valley())
    assert len(mbd.optimization.RobustProblem(Valley(MOST_DENSE // 50), 0.1).shifts) == 1 + 2 * MOST_DENSE // 50
