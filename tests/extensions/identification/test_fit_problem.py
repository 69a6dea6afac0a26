"""The least-squares problem: priors, links, failures, and arguments that are refused."""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd
from tests.extensions.identification import pendulum
from tests.refused import refused
from torchmbd.extensions.identification.fit_problem import FitProblem


def swing(**options) -> mbd.identification.Experiment:
    return pendulum.experiment(pendulum.data(), **options)


@pytest.mark.thorough
def test_priors_are_rows_of_their_own():
    priors = {"bob.mass": (1.0, 0.1), "spring.damping": (0.2, 0.05)}
    problem = FitProblem({"swing": swing()}, pendulum.UNKNOWNS, priors=priors)
    [residuals] = problem.evaluate(np.array([[1.2, 2.0, 0.15]]), True)
    np.testing.assert_allclose(residuals.values[-2:], [2.0, -1.0])
    np.testing.assert_allclose(residuals.jacobian[-2:], [[10.0, 0.0, 0.0], [0.0, 0.0, 20.0]])


@pytest.mark.thorough
def test_links_multiply_the_jacobian():
    """The damping is a tenth of the stiffness."""
    whole = FitProblem({"swing": swing()}, pendulum.UNKNOWNS)
    linked = FitProblem(
        {"swing": swing()}, pendulum.UNKNOWNS, links={"spring.damping[0]": {"spring.stiffness[0]": 0.1}}
    )
    [a], [b] = (
        p.evaluate(x, True) for p, x in ((whole, np.array([[1.2, 2.0, 0.2]])), (linked, np.array([[1.2, 2.0]])))
    )
    np.testing.assert_allclose(b.values, a.values)
    np.testing.assert_allclose(b.jacobian[:, 1], a.jacobian[:, 1] + 0.1 * a.jacobian[:, 2])


@pytest.mark.thorough
def test_a_design_that_cannot_be_has_a_status_and_the_others_their_numbers():
    problem = FitProblem({"swing": swing()}, pendulum.UNKNOWNS)
    good, bad = problem.evaluate(np.array([[1.2, 2.0, 0.15], [-1.2, 2.0, 0.15]]), True)
    assert good.ok
    assert bad.status.startswith("failed: ")
    assert np.isnan(bad.values).all()
    assert bad.jacobian is None


def test_more_unknowns_than_numbers_are_refused():
    """Gaps are no numbers, and constants no unknowns."""
    few = {"t": np.array([0.1, 0.2, 0.3]), "angle": np.array([0.1, np.nan, 0.2])}
    experiment = pendulum.experiment(few, angle=mbd.identification.Channel(pendulum.ANGLE, deviation=0.1))
    with refused("unknowns"):
        FitProblem({"swing": experiment}, pendulum.UNKNOWNS)
    assert FitProblem({"swing": experiment}, pendulum.UNKNOWNS, priors={"bob.mass": (1.0, 0.1)}).data == 2
    constant = {"spring.damping": (0.1, 0.1)}
    assert (
        FitProblem({"swing": experiment}, pendulum.UNKNOWNS, bounds=constant, start={"spring.damping": 0.1}).data == 2
    )


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"unknowns": ["bob.mas"]}, "unknowns.bob.mas"),
        ({"unknowns": "bob.mass"}, "unknowns"),
        ({"unknowns": ["bob.mass", "bob.mass"]}, "unknowns"),
        ({"unknowns": []}, "unknowns"),
        ({"unknowns": ["bob.mass"], "priors": {"bob.mass": 1.0}}, "prior.bob.mass"),
        ({"unknowns": ["bob.mass"], "priors": {"bob.mass": (1.0, 0.0)}}, "prior.bob.mass[0]"),
        ({"unknowns": ["bob.mass"], "priors": {"bob": (1.0, 1.0)}}, "prior.bob"),
        ({"unknowns": ["bob.mass"], "bounds": {"bob.mass": (2.0, 1.0)}}, "lower.bob.mass[0]"),
        ({"unknowns": ["bob.mass"], "bounds": {"bob.mass": (2.0, 3.0)}}, "start.bob.mass[0]"),
    ],
)
@pytest.mark.thorough
def test_bad_input_is_named(arguments, path):
    with refused(path):
        FitProblem({"swing": swing()}, **arguments)


def test_an_unknown_that_an_experiment_sets():
    series = mbd.identification.TimeSeries(pendulum.data(), {"angle": pendulum.ANGLE})
    experiment = mbd.identification.Experiment(pendulum.system(), series, {"bob.mass": 1.0})
    with refused("unknowns.bob.mass"):
        FitProblem({"swing": experiment}, ["bob.mass"])


def test_more_unknowns_than_numbers():
    t = np.array([0.1, 0.2])
    series = mbd.identification.TimeSeries({"t": t, "angle": t}, {"angle": pendulum.ANGLE})
    experiment = mbd.identification.Experiment(pendulum.system(), series)
    with refused("unknowns"):
        FitProblem({"swing": experiment}, pendulum.UNKNOWNS)


@pytest.mark.thorough
def test_a_held_out_channel_has_no_unknown_of_its_own():
    problem = FitProblem({"swing": swing()}, pendulum.UNKNOWNS)
    other = swing(angle=mbd.identification.Channel(pendulum.ANGLE, gain=mbd.variable(1.0)))
    with refused("validation.other", "angle.gain"):
        problem.held_out({"other": other})


def test_sensors_of_a_system_without_parameters():
    """Two designs of a delay, one motion."""
    channel = mbd.identification.Channel(mbd.Position("bob", "x"), deviation=1.0, delay=mbd.variable(0.0))
    series = mbd.identification.TimeSeries({"t": np.linspace(0.05, 0.2, 9), "x": np.zeros(9)}, {"x": channel})
    experiment = mbd.identification.Experiment(mbd.examples.pendulum(), series, steps=10, duration=0.3)
    problem = FitProblem({"swing": experiment}, [], {"x.delay": (-0.05, 0.05)})
    first, second = problem.evaluate(np.array([[0.0], [1e-4]]), True)
    assert (second.values < first.values).all()
    np.testing.assert_allclose(first.jacobian[:, 0], 1e4 * (second.values - first.values), rtol=0.01)
