"""Measured histories: what the model shows at their times, delays at the ends, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.extensions.identification import pendulum
from tests.refused import refused
from torchmbd.extensions.identification.fit_problem import FitProblem

TRUE = {"spring.stiffness": 2.0}


def residuals_of(experiment: mbd.identification.Experiment, **options) -> np.ndarray:
    [residuals] = FitProblem({"swing": experiment}, ["spring.stiffness"], **options).evaluate(np.array([[2.0]]), False)
    return residuals.values


@pytest.mark.thorough
def test_a_perfect_model_has_no_residuals_between_the_steps():
    experiment = pendulum.experiment(pendulum.data(), start=1.0)
    assert np.abs(residuals_of(experiment)).max() < 1e-9


@pytest.mark.thorough
def test_sensors_are_late_scaled_and_shifted():
    """angle: 2 y(t - 0.02) + 0.1 in degrees."""
    t = pendulum.TIMES
    y = np.rad2deg(2.0 * pendulum.shown(pendulum.ANGLE, t - 0.02) + 0.1)
    channel = mbd.identification.Channel(pendulum.ANGLE, "y", "deg", 1e-3, delay=0.02, gain=2.0, offset=0.1)
    series = mbd.identification.TimeSeries({"time [ms]": 1e3 * t, "y": y}, {"angle": channel}, time="time")
    experiment = mbd.identification.Experiment(pendulum.system(), series, steps=pendulum.STEPS, duration=1.0)
    assert np.abs(residuals_of(experiment)).max() < 1e-9


@pytest.mark.thorough
def test_gaps_and_deviations_of_each_row():
    numbers = pendulum.data()
    numbers["force"][3:9] = np.nan
    deviation = np.linspace(0.1, 0.2, 60)
    channels = {"force": mbd.identification.Channel(pendulum.FORCE - 1.0, deviation=deviation)}
    r = residuals_of(pendulum.experiment(numbers, 1.0, **channels))
    np.testing.assert_allclose(r, -1.0 / np.delete(deviation, slice(3, 9)), rtol=1e-9)


def test_samples_that_a_delay_puts_outside_are_left_out_and_told():
    channel = mbd.identification.Channel(pendulum.ANGLE, deviation=1.0, delay=mbd.variable(0.0))
    series = mbd.identification.TimeSeries(pendulum.data(), {"angle": channel})
    experiment = mbd.identification.Experiment(pendulum.system(), series, steps=pendulum.STEPS)
    problem = FitProblem({"swing": experiment}, ["spring.stiffness"], bounds={"angle.delay": (-0.1, 0.1)})
    [row] = problem.rows
    assert problem.experiments["swing"].duration == pytest.approx(1.0)  # 0.9 s and a delay of -0.1 s
    assert len(row.block.measured) == (pendulum.TIMES >= 0.1).sum() == 60 - 4
    assert row.block.note.startswith("4 samples are left out")


def test_a_link_bounds_a_delay():
    """The delay of one channel is twice that of the other."""
    channels = {
        "angle": mbd.identification.Channel(pendulum.ANGLE, deviation=1.0, delay=mbd.variable(0.0)),
        "force": mbd.identification.Channel(pendulum.FORCE, deviation=1.0, delay=mbd.variable(0.0)),
    }
    problem = FitProblem(
        {"swing": pendulum.experiment(pendulum.data(), 1.0, **channels)},
        [],
        bounds={"angle.delay": (0.0, 0.05)},
        links={"force.delay[0]": {"angle.delay[0]": 2.0}},
    )
    assert problem.names == ["angle.delay[0]"]
    assert [len(row.block.measured) for row in problem.rows] == [60, (pendulum.TIMES >= 0.1).sum()]


ROW = {"t": [0.0, 1.0], "x": [0.0, 1.0]}
X = mbd.Position("bob", "x")


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda: mbd.identification.TimeSeries({"t": [0.0, 2.0, 1.0], "x": [0, 0, 0]}, {"x": X}), "time"),
        (lambda: mbd.identification.TimeSeries({"t": [0.0, 0.0], "x": [0, 0]}, {"x": X}), "time"),
        (lambda: mbd.identification.TimeSeries({"t": [-0.1, 0.0], "x": [0, 0]}, {"x": X}), "time"),
        (lambda: mbd.identification.TimeSeries({"t": [0.0, np.nan], "x": [0, 0]}, {"x": X}), "time"),
        (lambda: mbd.identification.TimeSeries({"t": [], "x": []}, {"x": X}), "data"),
        (lambda: mbd.identification.TimeSeries({"t": [0.0], "x": [np.nan]}, {"x": X}), "channels.x"),
        (lambda: mbd.identification.TimeSeries({"t": [0.0], "x": [np.inf]}, {"x": X}), "channels.x"),
        (lambda: mbd.identification.TimeSeries(ROW, {"y": X}), "columns.y"),
        (lambda: mbd.identification.TimeSeries(ROW, {}), "channels"),
        (lambda: mbd.identification.TimeSeries(ROW, {"x": 3}), "channels.x"),
        (lambda: mbd.identification.TimeSeries({"t [mm]": [0.0], "x": [0.0]}, {"x": X}), "time"),
        (
            lambda: mbd.identification.TimeSeries(ROW, {"x": mbd.identification.Channel(X, unit="N")}),
            "columns.x",
        ),
        (
            lambda: mbd.identification.TimeSeries(ROW, {"x": mbd.identification.Channel(X, deviation=[1.0])}),
            "channels.x.deviation",
        ),
        (lambda: mbd.identification.Channel(X, unit="parsec"), "unit"),
        (lambda: mbd.identification.Channel(X, deviation=0.0), "deviation"),
        (lambda: mbd.identification.Channel(X, delay="late"), "delay"),
        (lambda: mbd.identification.Channel("x"), "response"),
        (lambda: mbd.identification.Channel(mbd.Angle("bob", "z", wrapped=True)), "response"),
    ],
)  # fmt: skip
def test_bad_input_is_named(make, path):
    with refused(path):
        make()


def test_times_that_do_not_increase_are_named_with_their_line(tmp_path):
    file = tmp_path / "run.csv"
    file.write_text("t,x\n0.0,1\n0.2,1\n0.1,1\n", encoding="utf-8")
    with refused("time", 0.1):
        mbd.identification.TimeSeries(file, {"x": X})


def test_a_channel_that_the_model_does_not_have():
    series = mbd.identification.TimeSeries(ROW, {"x": mbd.Position("bop", "x")})
    with refused("channels.x.body", meant="bob"):
        mbd.identification.Experiment(pendulum.system(), series)


@pytest.mark.parametrize(
    ("bounds", "path"),
    [
        ({}, "bounds.x.delay"),
        ({"x.delay": (0.0, 5.0)}, "channels.x"),
    ],
)
def test_bounds_of_delays(bounds, path):
    series = mbd.identification.TimeSeries(ROW, {"x": mbd.identification.Channel(X, delay=mbd.variable(0.0))})
    with refused(path):
        FitProblem({"swing": mbd.identification.Experiment(pendulum.system(), series)}, [], bounds)


def test_arrays_that_cannot_be_written_are_read(recwarn):
    """Columns of pandas are views that torch warns of."""
    t = np.linspace(0.0, 1.0, 20)
    y = np.sin(t)
    for x in (t, y):
        x.flags.writeable = False
    series = mbd.identification.TimeSeries({"t": t, "x": y}, {"x": mbd.Position("bob", "x")})
    torch.from_numpy(series.samples["x"].t)
    assert not [x for x in recwarn if "not writable" in str(x.message)]
