"""Experiments: settings, their own systems, durations."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.extensions.identification import pendulum
from tests.refused import refused
from torchmbd.extensions.identification.fit_problem import FitProblem


@pytest.mark.thorough
def test_settings_are_those_of_the_experiment():
    """Two bobs of other masses, one spring."""
    numbers = {m: pendulum.shown(pendulum.ANGLE, pendulum.TIMES, pendulum.system(mass=m)) for m in (0.8, 1.6)}
    experiments = {}
    for mass, y in numbers.items():
        series = mbd.identification.TimeSeries(
            {"t": pendulum.TIMES, "angle": y}, {"angle": mbd.identification.Channel(pendulum.ANGLE, deviation=1e-3)}
        )
        settings = {"bob.mass": mass}
        experiments[f"{mass} kg"] = mbd.identification.Experiment(
            pendulum.system(stiffness=2.5), series, settings, steps=pendulum.STEPS, duration=1.0
        )
    problem = FitProblem(experiments, ["spring.stiffness"])
    [residuals] = problem.evaluate(np.array([[2.0]]), True)
    assert residuals.jacobian.shape == (120, 1)
    assert np.abs(residuals.values).max() < 1e-9
    assert [row.name for row in problem.rows] == ["0.8 kg.angle", "1.6 kg.angle"]


@pytest.mark.thorough
def test_systems_may_differ_and_share_parameters():
    """One has no damper; the parameters of both are unknowns of one fit."""
    sprung = pendulum.system()
    [bob] = sprung.bodies
    free = mbd.System(
        [bob],
        [mbd.Revolute(mbd.Ground().at(), bob.at(0, 1.0, 0), "z", "hinge")],
        gravity=(0, -9.81, 0),
    )
    t = np.linspace(0.1, 1.0, 9)
    series = [
        mbd.identification.TimeSeries(
            {"t": t, "angle": 0 * t}, {"angle": mbd.identification.Channel(pendulum.ANGLE, deviation=1.0)}
        )
        for _ in "ab"
    ]
    both = {
        "free": mbd.identification.Experiment(free, series[0], steps=50),
        "sprung": mbd.identification.Experiment(sprung, series[1], steps=50),
    }
    [residuals] = FitProblem(both, ["spring.damping", "bob.mass"]).evaluate(np.array([[0.15, 1.2]]), True)
    assert not residuals.jacobian[:9, 0].any()
    assert residuals.jacobian[9:, 0].all()
    assert residuals.jacobian[:, 1].all()


def test_the_summary_says_what_is_measured():
    text = repr(
        mbd.identification.Experiment(
            pendulum.system(), mbd.identification.TimeSeries(pendulum.data(), {"angle": pendulum.ANGLE})
        )
    )
    assert "TimeSeries" in text
    assert "angle" in text


@pytest.mark.thorough
def test_steps_stay_those_of_the_first_motion(compiled):
    numbers = pendulum.data()
    series = mbd.identification.TimeSeries(
        numbers, {"angle": mbd.identification.Channel(pendulum.ANGLE, deviation=1.0)}
    )
    problem = FitProblem({"swing": mbd.identification.Experiment(pendulum.system(), series)}, ["spring.stiffness"])
    problem.evaluate(np.array([[2.0]]), False)
    first = problem.steps["swing"]
    problem.evaluate(np.array([[200.0]]), False)
    assert problem.steps["swing"] == first >= 200


SERIES = mbd.identification.TimeSeries({"t": pendulum.TIMES, "angle": 0 * pendulum.TIMES}, {"angle": pendulum.ANGLE})


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: mbd.identification.Experiment(3, SERIES), "system"),
        (lambda: mbd.identification.Experiment(pendulum.system(), 3), "measurements"),
        (lambda: mbd.identification.Experiment(pendulum.system(), []), "measurements"),
        (lambda: mbd.identification.Experiment(pendulum.system(), [SERIES, SERIES]), "angle"),
        (lambda: mbd.identification.Experiment(pendulum.system(), SERIES, {"bob.mas": 1.0}), "settings.bob.mas"),
        (lambda: mbd.identification.Experiment(pendulum.system(), SERIES, duration=-1.0), "duration"),
        (lambda: mbd.identification.Experiment(pendulum.system(), SERIES, method="newton"), "method"),
        (lambda: mbd.identification.Experiment(pendulum.system(), SERIES, start="rest"), "start"),
    ],
)
def test_bad_input_is_named(make, path):
    with refused(path):
        make()
