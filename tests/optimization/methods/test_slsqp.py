"""How SciPy's SLSQP ends here."""

import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize


@pytest.mark.parametrize("start", [3.0, 0.5, -2.0])
def test_a_contradiction_is_infeasible(start):
    """SciPy itself reports a failed line search, from every start."""
    problem = Analytic("contradiction", [start], lambda x: x[0] ** 2, lambda x: [1.0 - x[0], x[0]], lower=-5, upper=5)
    result = optimize(problem, method="slsqp", max_iterations=60)
    assert result.status == "infeasible"
    assert "constraints [0, 1] conflict" in result.message
