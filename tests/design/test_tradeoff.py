"""Several criteria of one motion: values, gradients, the front of a real mechanism, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import refused
from torchmbd.optimization import pareto_front

pytestmark = pytest.mark.usefixtures("compiled")

ENERGY = mbd.StrainEnergy("rod")
TWIST = mbd.RelativeDisplacement("rod", "corner_right_bottom", "corner_right_top", "z")
CRITERIA = {"energy": mbd.Integral(ENERGY), "twist": 1e3 * mbd.Integral(TWIST**2)}


def tradeoff(**given) -> mbd.Tradeoff:
    asked = {"minimize": CRITERIA, "subject_to": [mbd.Max(ENERGY) <= 1e-4], "bounds": mbd.deg([-90, 90])}
    return mbd.Tradeoff(pendulum(), 0.02, **({"steps": 20} | asked | given))


@pytest.mark.thorough
def test_values_and_gradients_are_those_of_the_measures():
    problem = tradeoff()
    X = np.radians([[20.0, -50.0], [70.0, 15.0]])
    result = problem.evaluate(X, True)
    motion = problem.problem.simulate(X, gradients=True)
    for k, measure in enumerate(CRITERIA.values()):
        value, gradient = measure.value_and_gradient(motion)
        assert [e.values[k] for e in result] == pytest.approx(value.tolist(), rel=1e-12)
        np.testing.assert_allclose([e.gradients[k] for e in result], gradient.numpy(), rtol=1e-10)
    peak = mbd.Max(ENERGY).value(motion).detach().numpy()
    np.testing.assert_allclose([e.constraints[0] for e in result], peak / 1e-4 - 1, rtol=1e-10)
    assert [e.constraint_gradients.shape for e in result] == [(1, 2)] * 2
    assert problem.evaluate(X, False)[0].gradients is None


@pytest.mark.thorough
def test_the_front_is_not_dominated_by_any_of_many_designs():
    problem = tradeoff(subject_to=[], steps=15)
    front = pareto_front(problem, divisions=2, starts=[np.radians([20.0, 30.0])], method="slsqp", max_iterations=12)
    F = front.criteria
    assert (np.diff(F, axis=0) * [1, -1] > 0).all()  # sorted: the one falls as the other grows
    sampled = np.array(
        [e.values for e in problem.evaluate(np.random.default_rng(0).uniform(-1.57, 1.57, (256, 2)), False)]
    )
    span = front.nadir - front.utopia
    for f in F:
        assert not np.any(np.all(sampled < f - 1e-3 * span, axis=1))


@pytest.mark.thorough
def test_a_failed_design_is_a_failed_evaluation():
    result = tradeoff(subject_to=[]).evaluate(np.array([[np.nan, 0.0], [0.1, 0.2]]), True)
    assert not result[0].ok
    assert result[1].ok


def test_what_it_refuses():
    with refused("minimize"):
        tradeoff(minimize={"energy": mbd.Integral(ENERGY)})
    with refused("minimize.peaks"):
        tradeoff(minimize={**CRITERIA, "peaks": mbd.AtPeaks(ENERGY)})
    with refused("subject_to"):
        tradeoff(subject_to=[mbd.Constraint(mbd.Max(ENERGY), "initial", "equal")])
