"""The contract of measurements: Jacobians of all residuals are those of Richardson's differences."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import torchmbd as mbd
from tests.extensions.identification import pendulum
from torchmbd.extensions.identification.fit_problem import FitProblem
from torchmbd.extensions.identification.registry import MEASUREMENTS


def richardson(problem: FitProblem, x: np.ndarray, size: np.ndarray, h: float = 2e-3) -> np.ndarray:
    """Derivatives [rows, n] by central differences of sixth order."""
    columns = []
    for k in range(len(x)):
        at = {}
        for m in (-3, -2, -1, 1, 2, 3):
            y = x.copy()
            y[k] += m * h * size[k]
            [residuals] = problem.evaluate(y[None], False)
            assert residuals.ok, residuals.status
            at[m] = residuals.values
        slope = 45.0 * (at[1] - at[-1]) - 9.0 * (at[2] - at[-2]) + (at[3] - at[-3])
        columns.append(slope / (60.0 * h * size[k]))
    return np.stack(columns, 1)


def time_series() -> FitProblem:
    """Angle, acceleration and force with unknown delay, gain and offset; a delay that two channels share; a prior."""
    delay = mbd.variable(0.011)
    late = mbd.identification.Channel(
        pendulum.ANGLE, deviation=0.1, delay=delay, gain=mbd.variable(1.1), offset=mbd.variable(0.03)
    )
    force = mbd.identification.Channel(pendulum.FORCE, deviation=1.0, delay=delay)
    sway = mbd.identification.Channel(mbd.Acceleration("bob", "x"), deviation=1.0, delay=mbd.variable(-0.013), gain=1.2)
    numbers = pendulum.data() | {"sway": np.where(np.arange(60) % 7, 0.1, np.nan)}
    experiment = pendulum.experiment(numbers, angle=late, force=force, sway=sway)
    bounds = {"angle.delay": (0.0, 0.04), "sway.delay": (-0.05, 0.0)}
    return FitProblem({"swing": experiment}, pendulum.UNKNOWNS, bounds, priors={"bob.mass": (1.0, 0.2)})


def static_curve() -> FitProblem:
    """A bob on a torsion spring, pushed aside by several forces: angle and force of the hinge, with a gap."""
    push = np.array([-2.0, -1.0, 0.0, 1.5, 4.0])
    numbers = {"F": push, "angle": 0.1 * push, "force": np.array([1.0, 2.0, np.nan, 3.0, 4.0])}
    channels = {
        "angle": mbd.identification.Channel(
            pendulum.ANGLE, deviation=0.1, gain=mbd.variable(1.1), offset=mbd.variable(0.02)
        ),
        "force": mbd.identification.Channel(pendulum.FORCE, deviation=1.0, gain=2.0),
    }
    curve = mbd.identification.StaticCurve(numbers, {"push.x": "F"}, channels)
    return FitProblem(
        {"pushed": mbd.identification.Experiment(pendulum.pushed(), curve)}, ["spring.stiffness", "bob.mass"]
    )


def modal_data() -> FitProblem:
    """Two masses in a row: frequencies and damping ratios of both modes, which shapes pair."""
    data = mbd.identification.ModalData([10.0, 20.0], [0.02, 0.03], [[1.0, 1.0], [1.2, -0.9]], pendulum.ROW_SENSORS)
    return FitProblem({"row": mbd.identification.Experiment(pendulum.row(), data)}, pendulum.ROW_UNKNOWNS)


def frequency_response(form: str, quantity: str) -> FitProblem:
    """Three outputs of a pendulum on a spring, pushed at its bob, near its resonance at 0.6 Hz."""
    data = {"frequency": [0.3, 0.55, 0.62, 2.0], "angle": np.full(4, 0.1 - 0.3j), "rate": np.full(4, -0.2 + 0.1j)}
    data |= {"tip": np.full(4, 0.02 + 0.1j)}
    model = pendulum.pushed()
    [hinge], [bob] = model.joints, model.bodies
    outputs = {"angle": mbd.signals.JointAngle(hinge), "rate": mbd.signals.JointRate(hinge)}
    outputs |= {"tip": (mbd.signals.PointPosition(bob.at(0.1, -0.2, 0.0)), "x")}
    push = mbd.signals.ForceOn(bob.at(0.0, -0.2, 0.0), "x")
    deviation = dict.fromkeys(outputs, 0.1)
    measured = mbd.identification.FrequencyResponseData(
        data, push, outputs, form=form, quantity=quantity, deviation=deviation
    )
    return FitProblem(
        {"pushed": mbd.identification.Experiment(model, measured, settings={"push.x": 3.0})}, pendulum.UNKNOWNS
    )


CASES = {
    "time_series": time_series,
    "static_curve": static_curve,
    "modal_data": modal_data,
    "frequency_responses": partial(frequency_response, "complex", "displacement"),
    "polar accelerations": partial(frequency_response, "polar", "acceleration"),
}


def test_every_measurement_has_a_case():
    assert set(CASES) >= set(MEASUREMENTS)


@pytest.mark.thorough
@pytest.mark.parametrize("name", CASES)
def test_jacobians_are_those_of_differences(name, compiled):
    problem = CASES[name]()
    x = problem.start
    # Of a delay less: a curve through samples is not smooth at the times of steps, which samples would pass.
    size = np.where(["delay" in name for name in problem.names], 1e-3, np.maximum(np.abs(x), 0.02))
    [residuals] = problem.evaluate(x[None], True)
    expected = richardson(problem, x, size)
    scale = np.abs(expected).max(0)
    assert (scale > 0.0).all()
    assert (np.abs(residuals.jacobian - expected) / scale).max() < 1e-6


@pytest.mark.thorough
@pytest.mark.parametrize("name", CASES)
def test_a_batch_has_the_residuals_of_each_of_its_designs(name):
    problem = CASES[name]()
    X = problem.start * np.array([[1.0], [1.01]])
    both = problem.evaluate(X, True)
    for x, residuals in zip(X, both, strict=True):
        [alone] = problem.evaluate(x[None], True)
        np.testing.assert_allclose(residuals.values, alone.values, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(residuals.jacobian, alone.jacobian, rtol=1e-5, atol=1e-6)
