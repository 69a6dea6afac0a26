"""SQCQP: what its models know, how many simulations the tube takes, and steps into designs that fail or violate a lot."""

from dataclasses import replace

import numpy as np
import pytest

from tests.optimization.analytic import Analytic
from tests.optimization.laminated_tube import OPTIMUM, laminated_tube
from torchmbd.optimization import optimize
from torchmbd.optimization.methods.sqcqp import Models


def test_models_of_quadratic_functions_are_exact_after_as_many_steps_as_variables():
    """Rank-one updates keep what they have learned: two indefinite functions of four variables, steps in any directions."""
    random = np.random.default_rng(0)
    A, g = random.normal(size=(2, 4, 4)), random.normal(size=(2, 4))
    H = A + A.transpose(0, 2, 1)
    models = Models(np.zeros(2), g)
    for d in random.normal(size=(4, 4)):
        models.learn(d, g + H @ d)
    d = random.normal(size=4)
    assert np.allclose(models.slopes(d), g + H @ d, rtol=1e-8)
    assert np.allclose(models.at(d), g @ d + 0.5 * (H @ d) @ d, rtol=1e-8)


@pytest.mark.parametrize(
    "start", [[0.93, 0.103, 0.73, 0.80], [0.39, -0.616, -0.112, 1.012], [0.25, 0.785, -0.785, 0.0]]
)
def test_a_laminated_tube(start):
    """Linearized constraints promise the thinnest wall, and SLSQP takes up to 60 simulations."""
    problem = laminated_tube(start)
    result = optimize(problem, "sqcqp")
    assert result.status == "converged"
    assert result.value == pytest.approx(OPTIMUM, rel=1e-5)
    assert problem.functions <= 35


def test_curved_constraints_do_not_shorten_the_steps():
    """min 2 (x^2 + y^2 - 1) - x on the unit circle: any step along the tangent raises objective and violation (Maratos)."""
    problem = Analytic(
        "circle",
        [0.0, 1.0],
        lambda x: 2 * (x[0] ** 2 + x[1] ** 2 - 1) - x[0] + 3,
        lambda x: [x[0] ** 2 + x[1] ** 2 - 1],
    )
    problem.equalities = [0]
    result = optimize(problem, "sqcqp", max_iterations=50)
    assert result.status == "converged"
    assert np.allclose(result.x, [1.0, 0.0], atol=1e-3)
    assert result.multipliers[0] == pytest.approx(-1.5, rel=1e-2)
    assert problem.functions <= 25


@pytest.mark.parametrize("bound", [1e2, 1e4, 1e6, 1e9])
def test_bounds_far_beyond_the_optimum(bound):
    """Half the range between bounds is no measure of steps here: the optimum is 2 away."""

    def f(x):
        return (x[0] - 1) ** 2 + (x[1] - 2) ** 2 + 1

    problem = Analytic("far", [3.0, 3.0], f, lambda x: [2 - x[0] - 0.1 * x[1]], lower=-bound, upper=bound)
    result = optimize(problem, "sqcqp", max_iterations=50)
    assert result.status == "converged"
    assert result.x == pytest.approx([1 + 0.8 / 1.01, 2 + 0.08 / 1.01], abs=1e-3)
    assert problem.functions <= 40


@pytest.mark.parametrize("lower", [-np.inf, 0.0])
def test_an_optimum_far_from_the_start_without_a_range(lower):
    """A thousand times the start: the trust region grows as long as the models are right."""
    problem = Analytic("far", [1.0], lambda x: 2 + (x[0] / 1e3 - 1) ** 2, lower=lower)
    result = optimize(problem, "sqcqp")
    assert result.status == "converged"
    assert result.x[0] == pytest.approx(1e3, rel=1e-3)
    assert problem.functions <= 20


@pytest.mark.parametrize("constant", [0.0, 1e3, 1e6])
def test_a_constant_of_the_objective_is_no_kink(constant):
    problem = Analytic(
        "valley", [-1.2, 1.0], lambda x: constant + (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2, lower=-3, upper=3
    )
    result = optimize(problem, "sqcqp")
    assert result.status == "converged"
    assert result.value - constant <= 1e-4


def test_a_design_that_fails_shortens_the_step():
    problem = Analytic(
        "cliff", [2.0, 2.0], lambda x: x[0] + x[1] ** 2 + 1, lower=-2, upper=3, fails=lambda x: x[0] < 0.5
    )
    result = optimize(problem, "sqcqp")
    assert result.failures
    assert 0.5 <= result.x[0] <= 0.51
    assert result.value < result.history[0].objective


def test_a_contradiction_is_infeasible():
    problem = Analytic("contradiction", [3.0], lambda x: x[0] ** 2, lambda x: [1.0 - x[0], x[0]], lower=-5, upper=5)
    result = optimize(problem, "sqcqp", max_iterations=60)
    assert result.status == "infeasible"
    assert "constraints [0, 1] conflict" in result.message
    assert "the models promise no lower violation" in result.message


def test_a_wrong_gradient_is_said_to_break_the_promise():
    """The gradient of the constraint has the wrong sign: every step raises the violation."""

    class Reversed(Analytic):
        def evaluate(self, X, gradients):
            evaluations = super().evaluate(X, gradients)
            return [replace(e, constraint_gradients=-e.constraint_gradients) for e in evaluations]

    problem = Reversed("reversed", [3.0], lambda x: x[0] ** 2 + 1, lambda x: [1.0 - x[0] / 5.0], lower=-5, upper=9)
    result = optimize(problem, "sqcqp")
    assert result.status != "converged"
    assert "no step, however short, does what the models promise" in result.message
