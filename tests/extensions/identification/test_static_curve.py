"""Static curves: equilibria under loads against closed forms, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

import torchmbd as mbd
from tests.extensions.identification import pendulum
from tests.refused import refused

PUSH = np.linspace(-8.0, 8.0, 9)


def angles(stiffness: float) -> np.ndarray:
    """k theta + m g sin theta = F cos theta of a bob of 1.2 kg at 1 m."""
    return np.array(
        [brentq(lambda a, F=F: stiffness * a + 1.2 * 9.81 * np.sin(a) - F * np.cos(a), -1.5, 1.5) for F in PUSH]
    )


@pytest.mark.thorough
def test_the_stiffness_of_a_spring():
    numbers = {"push [kN]": 1e-3 * PUSH, "angle [deg]": np.rad2deg(angles(3.0) + 0.01)}
    channel = mbd.identification.Channel(pendulum.ANGLE, deviation=1e-4, offset=mbd.variable(0.0))
    curve = mbd.identification.StaticCurve(numbers, {"push.x": "push"}, {"angle": channel})
    fit = mbd.identification.identify(mbd.identification.Experiment(pendulum.pushed(2.2), curve), ["spring.stiffness"])
    assert fit.status == "converged"
    np.testing.assert_allclose(fit.x, [3.0, 0.01], rtol=1e-6)
    assert fit.channels[0].rms < 1e-8


X = {"F": [0.0, 1.0], "x": [0.0, 0.1]}
POSITION = mbd.Position("bob", "x")


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: mbd.identification.StaticCurve(X, {}, {"x": POSITION}), "loads"),
        (lambda: mbd.identification.StaticCurve(X, {"push.x": "f"}, {"x": POSITION}), "columns.f"),
        (
            lambda: mbd.identification.StaticCurve(
                {"F": [0.0, np.nan], "x": [0.0, 0.1]}, {"push.x": "F"}, {"x": POSITION}
            ),
            "columns.F",
        ),
        (
            lambda: mbd.identification.StaticCurve(
                X, {"push.x": "F"}, {"x": mbd.identification.Channel(POSITION, delay=0.1)}
            ),
            "channels.x",
        ),
        (
            lambda: mbd.identification.StaticCurve(X, {"push.x": "F"}, {"x": mbd.Displacement("bob", "x") * 2.0}),
            "channels.x",
        ),
        (
            lambda: mbd.identification.Experiment(
                pendulum.pushed(), mbd.identification.StaticCurve(X, {"pusk.x": "F"}, {"x": POSITION})
            ),
            "loads.pusk.x",
        ),
        (
            lambda: mbd.identification.Experiment(
                pendulum.pushed(), mbd.identification.StaticCurve(X, {"push.x": "F"}, {"x": mbd.Position("bop", "x")})
            ),
            "channels.x.body",
        ),
    ],
)
def test_bad_input_is_named(make, path):
    with refused(path):
        make()


def test_a_load_is_no_unknown_and_no_setting():
    """It would replace the loads of all rows."""
    curve = mbd.identification.StaticCurve(
        {"F": [0.0, 1.0], "angle": [0.0, 0.1]}, {"push.x": "F"}, {"angle": pendulum.ANGLE}
    )
    with refused("unknowns.push.x"):
        mbd.identification.identify(mbd.identification.Experiment(pendulum.pushed(), curve), ["push.x"])
    with refused("settings", {"push.x": 1.0}):
        mbd.identification.Experiment(pendulum.pushed(), curve, settings={"push.x": 1.0})


def test_an_experiment_that_starts_at_rest():
    """Its motions start in equilibrium; the search for that of the curve starts assembled."""
    data = {"F": [1.0, 2.0], "angle": [0.07, 0.14]}
    curve = mbd.identification.StaticCurve(
        data, {"push.x": "F"}, {"angle": mbd.identification.Channel(pendulum.ANGLE, deviation=1e-3)}
    )
    fits = [
        mbd.identification.identify(
            mbd.identification.Experiment(pendulum.pushed(), curve, start=start), ["spring.stiffness"]
        )
        for start in ("equilibrium", "assembled")
    ]
    assert [fit.status for fit in fits] == ["converged"] * 2
    assert fits[0].x == pytest.approx(fits[1].x)
