"""Steps of motions move unknowns: they are made finer by the noise, or a warning says by how much."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

import torchmbd as mbd
from tests.refused import warned
from torchmbd.diagnosis.repetition import finer_count
from torchmbd.extensions.identification.step_error import SHARE, StepError, finer_steps, step_error

X = mbd.Position("bob", "x")
OMEGA, BETA = 20.0, 0.6  # of the oscillation [rad/s], of its decay [1/s]
NOISE = 5e-3


def oscillator(stiffness: float, damping: float) -> mbd.System:
    """A mass of 1 kg on a spring, which starts with a speed."""
    ground = mbd.Ground()
    body = mbd.RigidBody("bob", 1.0, (0.05, 0.05, 0.05), velocity=(6.0, 0, 0))
    numbers = {"stiffness": mbd.variable(stiffness), "damping": mbd.variable(damping)}
    spring = mbd.AxialSpringDamper(ground.at(), body.at(), axis="x", name="spring", **numbers)
    return mbd.System([body], [mbd.Prismatic(ground.at(), body.at(), axis="x")], [spring])


@cache
def measured() -> dict[str, np.ndarray]:
    """The closed form with noise, at times of no steps."""
    t = np.linspace(0.0, 1.0, 301)[1:] - 1e-3
    frequency = np.sqrt(OMEGA**2 - BETA**2)
    y = 6.0 / frequency * np.exp(-BETA * t) * np.sin(frequency * t)
    return {"t": t, "x": y + NOISE * np.random.default_rng(3).standard_normal(300)}


def fitted(steps: int | None) -> mbd.identification.Identification:
    series = mbd.identification.TimeSeries(measured(), {"x": mbd.identification.Channel(X, deviation=NOISE)})
    experiment = mbd.identification.Experiment(oscillator(0.9 * OMEGA**2, 2.0), series, steps=steps, duration=1.0)
    return mbd.identification.identify(experiment, ["spring.stiffness", "spring.damping"])


TRUTH = np.array([OMEGA**2, 2.0 * BETA])


@pytest.mark.thorough
def test_steps_follow_from_the_noise(compiled):
    """Steps that are left open are made finer until intervals hold the closed form."""
    fit = fitted(None)
    assert fit.converged
    assert fit.step_error.meets
    assert (np.abs(fit.x - TRUTH) < 3.0 * fit.deviation).all()


@pytest.mark.parametrize(("steps", "multiple"), [(500, 1), (500, 20), (12, 4), (7, 7)])
def test_finer_steps_share_no_factor_but_the_one_that_they_must(steps, multiple):
    """A load whose period divides a step shows one value in both motions otherwise, and no error is seen."""
    for factor in (2, 4):
        finer = finer_count(steps, multiple, factor)
        assert math.gcd(finer, steps) == multiple
        assert factor * steps <= finer <= (factor + 2) * steps + multiple


@pytest.mark.thorough
def test_given_steps_that_move_unknowns_are_told(compiled):
    """The shift that is told is how far the closed form is away."""
    with warned("150 steps", "spring.stiffness"):
        fit = fitted(150)
    assert "150 steps: their error moves unknowns" in str(fit)
    assert abs(fit.x[0] - TRUTH[0]) > 4.0 * fit.deviation[0]
    np.testing.assert_allclose(fit.step_error.shift[0], TRUTH[0] - fit.x[0], rtol=0.3)


def test_shifts_are_those_of_least_squares():
    """A line whose numbers have a known error."""
    x = np.linspace(0.0, 1.0, 50)
    J = np.stack([x, np.ones(50)], 1) / 0.1
    moves = np.linalg.solve(J.T @ J, J.T)
    e = 0.02 * x**2 / 0.1
    error = step_error({"a": (slice(0, 50), e)}, {}, moves, np.linalg.norm(moves, axis=1), np.ones(2))
    expected = np.linalg.lstsq(J, -e, rcond=None)[0]  # true minus fitted, of numbers that are e too small
    np.testing.assert_allclose(error.shift, expected)


def test_only_experiments_that_matter_have_more_steps():
    error = StepError(np.zeros(1), np.array([2.0]), {"a": 2.0, "b": 0.01})
    assert finer_steps({"a": 200, "b": 300}, {"a": 200, "b": 300}, error) == {"a": 800}
    assert finer_steps({"a": 3200}, {"a": 200}, error) == {}
    assert StepError(np.zeros(1), np.array([0.5 * SHARE]), {}).meets


@pytest.mark.thorough
def test_a_negative_damper_and_a_high_correlation_are_told():
    from tests.extensions.identification.closed_form import fit

    x = np.linspace(1.0, 1.1, 30)
    y = -0.5 * x + 2.0 + 0.01 * np.random.default_rng(0).standard_normal(30)
    result = fit({"y": (x, y, 0.01, lambda b, x: b["damping"] * x + b["c"])}, {"damping": 1.0, "c": 1.0})
    assert "damping[0] is negative" in str(result)
    assert "damping[0] and c[0] have a correlation of -0.99" in str(result)


def test_a_warning_that_differs_in_numbers_comes_once(recwarn):
    from torchmbd.errors import warn, warnings_once

    with warnings_once():
        for k in range(10):
            warn(f"a speed of {k}.5e-{k} m/s")
        warn("another speed")
    assert len([x for x in recwarn if "speed" in str(x.message)]) == 2


def test_a_study_is_one_with_its_searches_and_names_keep_their_numbers(recwarn):
    from torchmbd.errors import warn, warnings_once

    with warnings_once():
        for k in range(2):
            with warnings_once():
                for body in ("part_0", "part_1"):
                    warn(f"body '{body}' is loaded by 0.{k + 1} of its stiffness")
    texts = [str(x.message) for x in recwarn if "loaded" in str(x.message)]
    assert texts == [f"body 'part_{k}' is loaded by 0.1 of its stiffness" for k in (0, 1)]
