"""How SciPy's trust-constr ends here."""

import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize


@pytest.mark.parametrize("lower", [[1.0], [1.0, 2.0]])
@pytest.mark.parametrize("power", [1, 2])
def test_an_active_bound_is_met_to_the_tolerance_of_optimality(lower, power):
    """SciPy's own criteria hold off the bound, by 0.004 where a second variable has equal bounds."""
    upper = [5.0, 2.0][: len(lower)]
    problem = Analytic("bound", [3.0, 2.0][: len(lower)], lambda x: x[0] ** power, lower=lower, upper=upper)
    result = optimize(problem, method="trust-constr", max_iterations=100)
    assert result.status == "converged"
    assert float(result.x[0]) == pytest.approx(1.0, abs=1e-3)
