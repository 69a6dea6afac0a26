"""How SciPy's SLSQP ends here."""

import pytest

from tests.optimization.analytic import Analytic
from tests.optimization.laminated_tube import OPTIMUM, laminated_tube
from torchmbd.optimization import optimize


@pytest.mark.parametrize("start", [3.0, 0.5, -2.0])
def test_a_contradiction_is_infeasible(start):
    """SciPy itself reports a failed line search, from every start."""
    problem = Analytic("contradiction", [start], lambda x: x[0] ** 2, lambda x: [1.0 - x[0], x[0]], lower=-5, upper=5)
    result = optimize(problem, method="slsqp", max_iterations=60)
    assert result.status == "infeasible"
    assert "constraints [0, 1] conflict" in result.message


@pytest.mark.parametrize("start", [[0.93, 0.103, 0.73, 0.80], [0.39, -0.616, -0.112, 1.012]])
def test_a_first_step_that_raises_the_violation_is_no_end(start):
    """The first step thins the wall: the violation grows tenfold, and falls below that of the start in ten iterations."""
    problem = laminated_tube(start)
    result = optimize(problem, "slsqp")
    violations = [iterate.violation for iterate in result.history]
    assert violations[1] > 5.0 * violations[0] > 0.0
    assert result.status == "converged"
    assert result.value == pytest.approx(OPTIMUM, rel=1e-5)
    assert problem.functions <= 40
