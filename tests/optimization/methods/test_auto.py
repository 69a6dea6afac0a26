"""The default takes SQCQP for few variables and SLSQP for many, and says which."""

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize
from torchmbd.optimization.methods.auto import FEW


def bowl(size: int) -> Analytic:
    middle = np.linspace(-0.5, 0.5, size)
    return Analytic("bowl", [1.0] * size, lambda x: 1.0 + ((x - middle) ** 2).sum(), lower=-2, upper=2, optimum=1.0)


@pytest.mark.parametrize(("size", "name"), [(FEW, "sqcqp"), (FEW + 1, "slsqp")])
def test_the_number_of_variables_decides(size, name):
    result, same = optimize(bowl(size), max_iterations=50), optimize(bowl(size), name, max_iterations=50)
    assert np.array_equal(result.x, same.x)
    assert result.status == same.status == "converged"
    assert result.message == f"{name}: {same.message}"
    assert result.value == pytest.approx(1.0, abs=1e-6)


def test_slsqp_takes_over_where_sqcqp_creeps_along_a_kink():
    """A bent valley with a kink along its floor: no second derivatives there. The better of both ends counts."""

    def valley(x):
        side = x[0] - x[1] ** 2
        return 1.0 + 10.0 * np.sign(side.real) * side + (1.0 - x[1]) ** 2

    problem = Analytic("kinked valley", [-1.2, -1.0], valley, lower=-2, upper=2, optimum=1.0)
    alone = optimize(problem, "sqcqp", max_iterations=100)
    assert alone.status == "stalled"
    assert "kink" in alone.message
    result = optimize(problem, max_iterations=100)
    assert result.value < alone.value
    assert result.iterations == 100  # both methods together
    assert sum(np.array_equal(iterate.x, problem.start) for iterate in result.history) == 1
    assert result.message.startswith("slsqp: ")
    assert "after sqcqp: " in result.message
