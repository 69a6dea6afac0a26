"""The contract of responses: every history and every measure has the gradient of its value.

Histories on real motions with their neighbors as lanes; measures on series that are known in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from torchmbd.design import COMBINATORS, RESPONSES
from torchmbd.design.response import History, Valued
from torchmbd.integrators import Trajectory

STEP = 1e-5


@pytest.fixture(scope="module")
def motions() -> tuple[Trajectory, Trajectory]:
    """Two designs with sensitivities, and all their neighbors."""
    system, options = pendulum(), {"steps": 40, "iterations": (6, 6), "refresh": 1}
    angles = mbd.deg([[20.0, -50.0], [70.0, 15.0]])
    steps = STEP * torch.eye(2, dtype=torch.float64)
    neighbors = torch.cat([angles[:, None] + steps, angles[:, None] - steps], 1).flatten(0, 1)
    return tuple(
        mbd.simulate(
            system, 0.04, sensitivities=sensitivities, designs={"rod.laminate.angles": x}, **options
        ).require_ok()
        for sensitivities, x in ((True, angles), (False, neighbors))
    )


def difference(x: Tensor) -> Tensor:
    """[2 lanes x (up, up, down, down), ...] -> slopes [2 lanes, ..., 2 variables]."""
    up, down = x.unflatten(0, (2, 2, 2)).unbind(1)
    return ((up - down) / (2 * STEP)).movedim(1, -1)


@pytest.mark.parametrize("response", RESPONSES)
def test_gradient_of_a_history_against_differences(response, motions):
    history = RESPONSES[response]("rod")
    value, gradient = history.series(motions[0])
    assert value.shape == (2, 41)
    assert gradient.shape == (2, 41, 2)
    expected = difference(history.series(motions[1]).value)
    assert float(expected.abs().max()) > 0
    assert_close(gradient, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
    assert history.series(motions[1]).gradient is None


@pytest.mark.parametrize("response", RESPONSES)
@pytest.mark.parametrize("combinator", COMBINATORS)
def test_gradient_of_a_measure_against_differences(response, combinator, motions):
    measure = COMBINATORS[combinator](RESPONSES[response]("rod"))
    value, gradient = measure.value_and_gradient(motions[0])
    assert value.shape == (2,)
    assert_close(value, measure.value(motions[0]), rtol=0, atol=0)
    expected = difference(measure.value(motions[1]))
    assert_close(gradient, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))
    assert measure.of(motions[1]).gradient is None


@pytest.mark.parametrize("response", RESPONSES)
def test_a_body_that_does_not_exist_is_named(response, motions):
    with pytest.raises(mbd.InputError, match=r"body 'rdo' does not exist; allowed: .*did you mean 'rod'"):
        RESPONSES[response]("rdo").series(motions[0])
    with pytest.raises(mbd.InputError, match="body 'arm' is rigid; allowed here: a flexible body"):
        RESPONSES[response]("arm").series(motions[0])


@dataclass(frozen=True)
class Known(History):
    """Known series in place of a simulated one."""

    y: Tensor
    dy: Tensor | None = None

    def series(self, motion: Trajectory) -> Valued:
        return Valued(self.y, self.dy)


@dataclass
class Clock:
    """As much of a trajectory as measures look at."""

    t: Tensor


def wave(n: int, shift: float = 0.0) -> tuple[Clock, Known]:
    """y = b0 sin(4 t + b1) + b2 t at n times in 0..1 [s], with its gradient."""
    t = torch.linspace(0, 1, n, dtype=torch.float64)[None]
    b = torch.tensor([1.3, 0.4 + shift, 0.2], dtype=torch.float64)
    s, c = torch.sin(4 * t + b[1]), torch.cos(4 * t + b[1])
    return Clock(t[0]), Known(b[0] * s + b[2] * t, torch.stack([s, b[0] * c, t], -1))


def exact_peak(shift: float = 0.0) -> tuple[float, list[float]]:
    b0, b1, b2 = 1.3, 0.4 + shift, 0.2
    t = (math.acos(-b2 / (4 * b0)) - b1) / 4
    s, c = math.sin(4 * t + b1), math.cos(4 * t + b1)
    return b0 * s + b2 * t, [s, b0 * c, t]


def test_the_integral_converges_at_second_order():
    exact = 1.3 * (math.cos(0.4) - math.cos(4.4)) / 4 + 0.1
    errors = [abs(float(mbd.Integral(history).of(clock).value[0]) - exact) for clock, history in (wave(51), wave(101))]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert errors[1] < 2e-4


@pytest.mark.parametrize("shift", [0.0, 0.01, 0.02, 0.031, 0.037])
def test_the_peak_is_found_between_the_samples(shift):
    """At the best sample the value would be 2e-4 off and the gradient 2 %; the spline is good to the fourth order."""
    clock, history = wave(61, shift)
    value, gradient = mbd.Max(history).of(clock)
    exact, slopes = exact_peak(shift)
    assert float(value[0]) == pytest.approx(exact, abs=2e-7)
    assert gradient[0].tolist() == pytest.approx(slopes, abs=2e-5)


def test_the_peak_moves_past_a_sample_without_a_jump():
    """Value and gradient are continuous where the peak crosses a sample: a kink would stop an optimizer."""
    shifts = torch.linspace(0.0, 4.0 / 60, 400, dtype=torch.float64).tolist()
    found = [mbd.Max(wave(61, shift)[1]).of(wave(61, shift)[0]) for shift in shifts]
    values = torch.stack([x.value[0] for x in found])
    gradients = torch.stack([x.gradient[0] for x in found])
    step = shifts[1]
    assert float((values[1:] - values[:-1]).abs().max()) < 2 * step * float(gradients.abs().max())
    assert float((gradients[1:] - gradients[:-1]).abs().max()) < 4 * step
    # And the gradient by the shift is the slope of the value.
    slope = (values[2:] - values[:-2]) / (2 * step)
    assert_close(slope, gradients[1:-1, 1], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("y", "peak", "at"),
    [
        ([3.0, 2.0, 1.5, 1.2, 1.1, 1.0], 3.0, 0),
        ([1.0, 1.1, 1.2, 1.5, 2.0, 3.0], 3.0, 5),
        ([2.0, 1.0], 2.0, 0),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 0.0, None),
    ],
)
def test_a_peak_at_an_end_is_the_end(y, peak, at):
    n = len(y)
    series, slopes = torch.tensor([y], dtype=torch.float64), torch.arange(float(n), dtype=torch.float64)[None, :, None]
    value, gradient = mbd.Max(Known(series, slopes)).of(Clock(torch.linspace(0, 1, n)))
    assert value.tolist() == [peak]
    if at is not None:
        assert gradient.tolist() == [[float(at)]]


def test_a_failed_lane_stays_nan_and_alone():
    """Numbers of a failed lane must not pass for a maximum."""
    clock, history = wave(61)
    y, dy = history.y.repeat(2, 1), history.dy.repeat(2, 1, 1)
    y[1, 30:], dy[1, 30:] = torch.nan, torch.nan
    for measure in (mbd.Max, mbd.Integral):
        value, gradient = measure(Known(y, dy)).of(clock)
        alone = measure(history).of(clock)
        assert_close(value[0], alone.value[0])
        assert_close(gradient[0], alone.gradient[0])
        assert value[1].isnan()
