"""L-BFGS-B inside augmented Lagrangians: cases that its line search and a first penalty are not made for."""

from __future__ import annotations

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from tests.optimization.counts import error
from tests.optimization.hock_schittkowski import hock_schittkowski
from torchmbd.optimization import optimize

BY_NAME = {problem.name: problem for problem in hock_schittkowski()}


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["HS24", "HS44", "HS113"])
def test_known_optimum(name):
    """HS24, HS44: the objective falls without end beside the first penalty. HS113: steep constraints of a flat objective."""
    result = optimize(BY_NAME[name], "lbfgs", max_iterations=1000)
    assert result.status == "converged"
    assert error(BY_NAME[name], result.value) <= 1e-6
    assert result.violation <= 1e-6


@pytest.mark.thorough
def test_no_minimum_at_all():
    """Designs stay numbers (`Analytic.evaluate` refuses others), and no optimum is claimed."""
    problem = Analytic("cubic", [1.0, 1.0], lambda x: x[0] ** 3 - x[1] ** 4, lambda x: [x[0] + x[1] - 4])
    result = optimize(problem, "lbfgs", max_iterations=200)
    assert result.status != "converged"
    assert np.isfinite(result.x).all()


def test_a_failed_evaluation_is_above_a_violated_design():
    """The start violates its constraint by 19.8, so L is far above f; a design that fails is no way down."""
    problem = Analytic(
        "edge",
        [0.1, 0.1],
        lambda x: x[0] + x[1] + 1,
        lambda x: [20 - (x[0] + x[1])],
        lower=-5.0,
        upper=50.0,
        fails=lambda x: bool(x[0] > 12),
    )
    result = optimize(problem, "lbfgs", max_iterations=200)
    assert result.status == "many_failures"
    assert "apart from this, converged: " in result.message
    assert result.value == pytest.approx(21.0, rel=1e-6)
