"""Measures of known histories against closed forms, and of the design against the body itself."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import refused
from torchmbd.design import RMS, AtTime, AtTimes, Final, Frequency, Mass, Mean, Min, SmoothMax, history
from torchmbd.results.time_rows import TensorSignals
from torchmbd.results.trajectory import Trajectory


@history
def wave(motion):
    """y = 1.3 sin(4 t + 0.4) + 0.2 t, two lanes, the second reversed in sign."""
    y = 1.3 * torch.sin(4 * motion.t + 0.4) + 0.2 * motion.t
    return torch.stack([y, -y])


def clock(n: int) -> Any:
    """As much of a motion as these measures look at: n times in 0..1 [s]."""
    rows = {name: torch.zeros(2, n, 1, dtype=torch.float64) for name in ("q", "v", "a", "lam")}
    nothing: Any = None
    dynamics: Any = SimpleNamespace(topology=SimpleNamespace(actions=()))
    times = torch.linspace(0, 1, n, dtype=torch.float64)
    return Trajectory(times, TensorSignals(rows), ["ok", "ok"], {}, None, dynamics, nothing)


def exact(t: float) -> float:
    return 1.3 * math.sin(4 * t + 0.4) + 0.2 * t


def antiderivative(t: float) -> float:
    return -1.3 * math.cos(4 * t + 0.4) / 4 + 0.1 * t * t


def value(measure, n: int) -> float:
    result: Tensor = measure.value(clock(n))
    assert result.shape == (2,)
    return float(result[0])


@pytest.mark.parametrize("window", [None, (0.217, 0.731)])
def test_the_integral_converges_at_fourth_order(window):
    """That of the cubic: the trapezoidal rule would leave an error of second order from the ends."""
    first, last = window or (0.0, 1.0)
    whole = antiderivative(last) - antiderivative(first)
    errors = [abs(value(mbd.Integral(wave, window), n) - whole) for n in (51, 101, 201)]
    assert math.log2(errors[0] / errors[2]) / 2 == pytest.approx(4.0, abs=0.3)
    assert errors[2] < 1e-8
    mean = value(Mean(wave, window), 201)
    assert mean == pytest.approx(value(mbd.Integral(wave, window), 201) / (last - first), rel=1e-12)


def test_root_mean_square():
    times = torch.linspace(0.2, 0.7, 100_001, dtype=torch.float64)
    y = 1.3 * torch.sin(4 * times + 0.4) + 0.2 * times
    assert value(RMS(wave, (0.2, 0.7)), 401) == pytest.approx(float(y.square().mean().sqrt()), rel=1e-4)
    assert RMS(wave).value(clock(101))[0] == RMS(wave).value(clock(101))[1]


def test_extremes_times_and_end():
    peak = (math.acos(-0.2 / 5.2) - 0.4) / 4
    assert value(mbd.Max(wave), 101) == pytest.approx(exact(peak), abs=1e-7)
    assert Min(wave).value(clock(101)).tolist() == pytest.approx([exact(1.0), -exact(peak)], abs=1e-7)
    assert value(AtTime(wave, 0.4321), 101) == pytest.approx(exact(0.4321), abs=1e-7)
    assert value(Final(wave), 11) == pytest.approx(exact(1.0))
    assert value(Final(wave, (0.0, 0.555)), 101) == pytest.approx(exact(0.555), abs=1e-7)
    rows = AtTimes(wave, times=(0.1, 0.25)).value(clock(101))
    assert rows[1].tolist() == pytest.approx([-exact(0.1), -exact(0.25)], abs=1e-7)
    rows = AtTimes(wave, window=(0.2, 0.6), count=3).value(clock(101))
    assert rows[0].tolist() == pytest.approx([exact(0.2), exact(0.4), exact(0.6)], abs=1e-7)


@pytest.mark.parametrize("sharpness", [5.0, 50.0, 5000.0])
def test_the_smooth_maximum_lies_above_the_largest_sample(sharpness):
    """By at most c ln(n) / rho: Kreisselmeier and Steinhauser's bound; large exponents do not overflow."""
    n, scale = 101, 0.5
    samples = wave.values(clock(n))[0]
    over = value(SmoothMax(wave, sharpness=sharpness, scale=scale), n) - float(samples.max())
    assert 0.0 < over <= scale * math.log(n) / sharpness


def test_measures_of_the_design():
    system = pendulum(modes=3)
    motion = mbd.simulate(system, 0.001, steps=2)
    rod = system.body("rod").structure()
    lowest = torch.linalg.eigvalsh(rod["Kr"]).sqrt() / (2 * math.pi)
    for number in (1, 2, 3):
        assert float(Frequency("rod", number).value(motion)) == pytest.approx(float(lowest[number - 1].detach()))
    assert float(Mass("rod").value(motion)) == pytest.approx(1586.0 * 0.3 * 0.1 * 3e-3)
    assert float(Mass().value(motion)) == pytest.approx(1586.0 * 0.3 * 0.1 * 3e-3 + 0.7)
    with refused("number", 4):
        Frequency("rod", 4).check(system)


@pytest.mark.parametrize(
    ("function", "found"),
    [(lambda m: 3.0, "3.0"), (lambda m: m.t, r"shape \(5,\)"), (lambda m: torch.zeros(2, 5, 1), r"shape \(2, 5, 1\)")],
)
def test_a_response_of_one_s_own_must_have_the_shape_of_one(function, found):
    with pytest.raises(
        mbd.InputError, match=rf"returned {found}.*: must return a tensor of shape \(2, 5\), real numbers"
    ):
        mbd.Max(history(function)).value(clock(5))


@pytest.mark.thorough
def test_few_numbers_in_reverse_and_many_in_forward_mode_have_the_same_gradients():
    """One time alone is differentiated backward, a hundred together forward."""
    system = pendulum()
    motion = mbd.simulate(system, 0.02, steps=20, gradients="forward")
    times = torch.linspace(0.0, 0.02, 100, dtype=torch.float64).tolist()
    for own in (
        mbd.StrainEnergy("rod"),
        mbd.Displacement("rod", "z", node="right"),
        mbd.Velocity("rod", "y", node="right"),
    ):
        many = AtTimes(own, times=times).value_and_gradient(motion)
        assert many.gradient is not None
        assert many.gradient.shape[1] > len(motion.parameters)
        for k in (1, 42, 99):
            one = AtTime(own, times[k]).value_and_gradient(motion)
            torch.testing.assert_close(one.value, many.value[:, k], rtol=1e-13, atol=0)
            torch.testing.assert_close(one.gradient, many.gradient[:, k], rtol=1e-10, atol=1e-13)


def test_the_value_at_a_time_is_that_of_a_history():
    with refused("history", "rod"):
        AtTime("rod", 0.1)


def test_an_equilibrium_has_values_at_its_times():
    """One time, and times at unequal distances: a bead on a rail under a force of 50 t^2 across it."""
    bead = mbd.RigidBody("bead", 1.0, (0.01, 0.01, 0.01))
    rail = mbd.Prismatic(mbd.Ground().at(), bead.at(), axis="x", name="rail")
    push = mbd.Force(bead.at(), lambda t: torch.stack([0.0 * t, 50.0 * t**2, 0.0 * t]), name="push")
    system, reaction = mbd.System([bead], [rail], [push]), mbd.Reaction("rail", "y")
    rest = mbd.equilibrium(system, 1.0)
    assert AtTime(reaction, float(rest.t[0]))(rest).item() == pytest.approx(-50.0)
    path = mbd.equilibrium(system, [0.0, 0.01, 0.02, 0.5, 1.0])
    assert Min(reaction)(path).item() == pytest.approx(-50.0)
    assert AtTime(reaction, 0.25)(path).item() == pytest.approx(-3.125)


@pytest.mark.thorough
@pytest.mark.parametrize("number", [0, -1, 3, 1.5, True])
def test_a_frequency_that_does_not_exist_is_named(number):
    """Also where no Problem has looked at the measure: 0 and -1 would be the last ones."""
    motion = mbd.simulate(pendulum(), 0.01, steps=2)
    with refused("number"):
        mbd.Frequency("rod", number).value(motion)


def test_as_many_peaks_as_intervals_are_allowed():
    motion = mbd.simulate(mbd.examples.pendulum(), 0.2, steps=4)
    height = mbd.Position("bob", "y")
    peaks = mbd.AtPeaks(height, count=4)(motion)
    assert peaks.shape == (1, 4)
    assert float(peaks[0, 0]) == float(mbd.Max(height)(motion))
    with refused("count", 5):
        mbd.AtPeaks(height, count=5)(motion)
