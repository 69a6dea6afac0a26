"""The default takes SQCQP for few variables and SLSQP for many, and says which."""

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from torchmbd.optimization import optimize
from torchmbd.optimization.methods import auto as methods
from torchmbd.optimization.methods.auto import FEW
from torchmbd.optimization.optimizer import Ending


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


def kinked_valley(**options) -> Analytic:
    """A bent valley with a kink along its floor: no second derivatives there."""

    def valley(x):
        side = x[0] - x[1] ** 2
        return 1.0 + 10.0 * np.sign(side.real) * side + (1.0 - x[1]) ** 2

    return Analytic("kinked valley", [-1.2, -1.0], valley, lower=-2, upper=2, optimum=1.0, **options)


def test_slsqp_takes_over_where_sqcqp_creeps_along_a_kink():
    """The better of both ends counts."""
    problem = kinked_valley()
    alone = optimize(problem, "sqcqp", max_iterations=100)
    assert alone.status == "stalled"
    assert "kink" in alone.message
    result = optimize(problem, max_iterations=100)
    assert result.value < alone.value
    assert result.iterations == 100  # both methods together
    assert sum(np.array_equal(iterate.x, problem.start) for iterate in result.history) == 1
    assert result.message.startswith("slsqp: ")
    assert "after sqcqp: " in result.message


def test_the_first_end_counts_where_the_second_is_worse(monkeypatch):
    monkeypatch.setattr(methods, "slsqp", lambda search, *_, **__: Ending(search.start, "stalled", "gave up"))
    alone, result = optimize(kinked_valley(), "sqcqp"), optimize(kinked_valley())
    assert np.array_equal(result.x, alone.x)
    assert result.message.startswith(f"sqcqp: {alone.message.split(';')[0]}; nothing better by slsqp: gave up")


def test_where_designs_fail_slsqp_is_not_tried(monkeypatch):
    monkeypatch.setattr(methods, "slsqp", lambda *_, **__: pytest.fail("slsqp was run"))
    result = optimize(kinked_valley(fails=lambda x: x[0] > 0.0))
    assert result.failures
    assert not result.converged
    assert "stalled: sqcqp: " in result.message
