"""Measured histories: what the model shows at their times, delays at the ends, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.extensions.identification import pendulum
from torchmbd.extensions.identification.fit_problem import FitProblem

TRUE = {"spring.stiffness": 2.0}


def residuals_of(experiment: mbd.Experiment, **options) -> np.ndarray:
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
    channel = mbd.Channel(pendulum.ANGLE, "y", "deg", 1e-3, delay=0.02, gain=2.0, offset=0.1)
    series = mbd.TimeSeries({"time [ms]": 1e3 * t, "y": y}, {"angle": channel}, time="time")
    experiment = mbd.Experiment(pendulum.system(), series, steps=pendulum.STEPS, duration=1.0)
    assert np.abs(residuals_of(experiment)).max() < 1e-9


@pytest.mark.thorough
def test_gaps_and_deviations_of_each_row():
    numbers = pendulum.data()
    numbers["force"][3:9] = np.nan
    deviation = np.linspace(0.1, 0.2, 60)
    channels = {"force": mbd.Channel(pendulum.FORCE - 1.0, deviation=deviation)}
    r = residuals_of(pendulum.experiment(numbers, 1.0, **channels))
    np.testing.assert_allclose(r, -1.0 / np.delete(deviation, slice(3, 9)), rtol=1e-9)


def test_samples_that_a_delay_puts_outside_are_left_out_and_told():
    channel = mbd.Channel(pendulum.ANGLE, deviation=1.0, delay=mbd.variable(0.0))
    series = mbd.TimeSeries(pendulum.data(), {"angle": channel})
    experiment = mbd.Experiment(pendulum.system(), series, steps=pendulum.STEPS)
    problem = FitProblem({"swing": experiment}, ["spring.stiffness"], bounds={"angle.delay": (-0.1, 0.1)})
    [row] = problem.rows
    assert problem.experiments["swing"].duration == pytest.approx(1.0)  # 0.9 s and a delay of -0.1 s
    assert len(row.block.measured) == (pendulum.TIMES >= 0.1).sum() == 60 - 4
    assert row.block.note.startswith("4 samples are left out")


def test_a_link_bounds_a_delay():
    """The delay of one channel is twice that of the other."""
    channels = {
        "angle": mbd.Channel(pendulum.ANGLE, deviation=1.0, delay=mbd.variable(0.0)),
        "force": mbd.Channel(pendulum.FORCE, deviation=1.0, delay=mbd.variable(0.0)),
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
    ("make", "message"),
    [
        (lambda: mbd.TimeSeries({"t": [0.0, 2.0, 1.0], "x": [0, 0, 0]}, {"x": X}), "row 2: time 1 s follows 2 s; allowed"),
        (lambda: mbd.TimeSeries({"t": [0.0, 0.0], "x": [0, 0]}, {"x": X}), "row 1: time 0 s follows 0 s"),
        (lambda: mbd.TimeSeries({"t": [-0.1, 0.0], "x": [0, 0]}, {"x": X}), "row 0: time is -0.1 s; allowed: from 0 on"),
        (lambda: mbd.TimeSeries({"t": [0.0, np.nan], "x": [0, 0]}, {"x": X}), "row 1: time 't' is nan; allowed: a finite"),
        (lambda: mbd.TimeSeries({"t": [], "x": []}, {"x": X}), "data has no rows; allowed: one time"),
        (lambda: mbd.TimeSeries({"t": [0.0], "x": [np.nan]}, {"x": X}), "channel 'x' has gaps alone"),
        (lambda: mbd.TimeSeries({"t": [0.0], "x": [np.inf]}, {"x": X}), "row 0: channel 'x' is inf; allowed: finite"),
        (lambda: mbd.TimeSeries(ROW, {"y": X}), "column 'y' does not exist; allowed: t, x"),
        (lambda: mbd.TimeSeries(ROW, {}), "channels is .*; allowed: name -> mbd.Channel"),
        (lambda: mbd.TimeSeries(ROW, {"x": 3}), "channel 'x' is 3; allowed: mbd.Channel"),
        (lambda: mbd.TimeSeries({"t [mm]": [0.0], "x": [0.0]}, {"x": X}), r"unit of the times 't' is of \[m\]; allowed: s, ms"),
        (
            lambda: mbd.TimeSeries(ROW, {"x": mbd.Channel(X, unit="N")}),
            r"unit of channel 'x' is of \[N\]; allowed: one of \[m\]",
        ),
        (lambda: mbd.TimeSeries(ROW, {"x": mbd.Channel(X, deviation=[1.0])}), "deviation of channel 'x' has 1 values"),
        (lambda: mbd.Channel(X, unit="parsec"), "unit of Channel is 'parsec'; allowed: "),
        (lambda: mbd.Channel(X, deviation=0.0), "deviation of Channel is 0.0"),
        (lambda: mbd.Channel(X, delay="late"), "delay of Channel is 'late'; allowed: a finite number, or mbd.variable"),
        (lambda: mbd.Channel("x"), "response of Channel is 'x'; allowed: a history"),
        (lambda: mbd.Channel(mbd.Angle("bob", "z", wrapped=True)), "wrapped=True, which jumps"),
    ],
)  # fmt: skip
def test_bad_input_is_named(make, message):
    with pytest.raises(mbd.InputError, match=message):
        make()


def test_times_that_do_not_increase_are_named_with_their_line(tmp_path):
    file = tmp_path / "run.csv"
    file.write_text("t,x\n0.0,1\n0.2,1\n0.1,1\n", encoding="utf-8")
    with pytest.raises(mbd.InputError, match=r"run.csv, line 4: time 0.1 s follows 0.2 s"):
        mbd.TimeSeries(file, {"x": X})


def test_a_channel_that_the_model_does_not_have():
    series = mbd.TimeSeries(ROW, {"x": mbd.Position("bop", "x")})
    with pytest.raises(mbd.InputError, match=r"channel 'x': body 'bop' does not exist.*did you mean 'bob'"):
        mbd.Experiment(pendulum.system(), series)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({}, r"bounds of x.delay are \(-inf, inf\) s; allowed: finite bounds"),
        ({"x.delay": (0.0, 5.0)}, "channel 'x' has no sample within the motion, 0 to 1 s, for a delay of 0 to 5 s"),
    ],
)
def test_bounds_of_delays(bounds, message):
    series = mbd.TimeSeries(ROW, {"x": mbd.Channel(X, delay=mbd.variable(0.0))})
    with pytest.raises(mbd.InputError, match=message):
        FitProblem({"swing": mbd.Experiment(pendulum.system(), series)}, [], bounds)


def test_arrays_that_cannot_be_written_are_read(recwarn):
    """Columns of pandas are views that torch warns of."""
    t = np.linspace(0.0, 1.0, 20)
    y = np.sin(t)
    for x in (t, y):
        x.flags.writeable = False
    series = mbd.TimeSeries({"t": t, "x": y}, {"x": mbd.Position("bob", "x")})
    torch.from_numpy(series.samples["x"].t)
    assert not [x for x in recwarn if "not writable" in str(x.message)]
