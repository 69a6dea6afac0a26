"""A sampled history between its samples: values, windows and peaks against closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.refused import refused
from torchmbd.design.slopes import slopes
from torchmbd.design.spline import Spline

pytestmark = pytest.mark.usefixtures("compiled")

B = (1.3, 0.4, 0.2)


def wave(n: int, b: Tensor | None = None) -> Spline:
    """y = b0 sin(4 t + b1) + b2 t at n times in 0..1 [s]."""
    b = torch.tensor(B, dtype=torch.float64) if b is None else b
    t = torch.linspace(0, 1, n, dtype=torch.float64)
    return Spline.of(t, (b[0] * torch.sin(4 * t + b[1]) + b[2] * t)[None])


def exact_peak(shift: float = 0.0) -> tuple[float, list[float], float]:
    """Value, gradient and time of the maximum."""
    b0, b1, b2 = B[0], B[1] + shift, B[2]
    t = (math.acos(-b2 / (4 * b0)) - b1) / 4
    s, c = math.sin(4 * t + b1), math.cos(4 * t + b1)
    return b0 * s + b2 * t, [s, b0 * c, t], t


def peak(shift: float = 0.0, n: int = 61) -> tuple[Tensor, Tensor]:
    """Maximum and its gradient."""
    b = torch.tensor(B, dtype=torch.float64) + torch.tensor([0.0, shift, 0.0], dtype=torch.float64)
    return wave(n, b).maximum()[0], torch.func.jacfwd(lambda x: wave(n, x).maximum()[0])(b)


@pytest.mark.parametrize("shift", [0.0, 0.01, 0.02, 0.031, 0.037])
def test_the_peak_is_found_between_the_samples(shift):
    """At the best sample the value would be 2e-4 off and the gradient 2 %; the spline is good to the fourth order."""
    value, gradient = peak(shift)
    exact, slopes, _ = exact_peak(shift)
    assert float(value) == pytest.approx(exact, abs=2e-7)
    assert gradient.tolist() == pytest.approx(slopes, abs=2e-5)


@pytest.mark.thorough
def test_the_peak_moves_past_a_sample_without_a_jump():
    """Value and gradient are continuous where the peak crosses a sample: a kink would stop an optimizer."""
    shifts = torch.linspace(0.0, 4.0 / 60, 400, dtype=torch.float64).tolist()
    result = [peak(shift) for shift in shifts]
    values, gradients = torch.stack([x for x, _ in result]), torch.stack([g for _, g in result])
    step = shifts[1]
    assert float((values[1:] - values[:-1]).abs().max()) < 2 * step * float(gradients.abs().max())
    assert float((gradients[1:] - gradients[:-1]).abs().max()) < 4 * step
    # And the gradient by the shift is the slope of the value.
    slope = (values[2:] - values[:-2]) / (2 * step)
    assert_close(slope, gradients[1:-1, 1], rtol=0, atol=1e-5)


def test_between_the_samples_at_third_order():
    """Second order at the ends of the slopes leaves h^3 there."""
    times = torch.linspace(0, 1, 1001, dtype=torch.float64)
    exact = B[0] * torch.sin(4 * times + B[1]) + B[2] * times
    errors = [float((wave(n).at(times)[0] - exact).abs().max()) for n in (41, 81)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(3.0, abs=0.2)
    assert errors[1] < 2e-5
    slope = 4 * B[0] * torch.cos(4 * times + B[1]) + B[2]
    assert_close(wave(161).at(times, 1)[0], slope, rtol=0, atol=2e-3)


def vibration(n: int, b: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """y = b0 sin(30 t + b1) + b1 t at n times in 0..1 [s], with its rates; five samples per period for n = 25."""
    t = torch.linspace(0, 1, n, dtype=torch.float64)
    y, slope = b[0] * torch.sin(30 * t + b[1]) + b[1] * t, 30 * b[0] * torch.cos(30 * t + b[1]) + b[1]
    return t, y[None], (slope[None], -900 * b[0] * torch.sin(30 * t + b[1])[None])


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.7, 1.1, 1.9])
def test_known_rates_find_the_peaks_of_a_coarsely_sampled_vibration(phase):
    """Among 20,000 points of the formula itself; differences of the samples are 50 times worse."""
    b = torch.tensor([1.3, phase], dtype=torch.float64)
    exact = float(vibration(20_001, b)[1].max())
    t, y, rates = vibration(25, b)
    curve = Spline.of(t, y, rates=rates)
    assert float(curve.maximum()) == pytest.approx(exact, abs=2e-4 * exact)
    assert float(curve.peaks(1)) == float(curve.maximum())
    lowest = float(-vibration(20_001, b)[1].min())
    assert float(curve.negative().maximum()) == pytest.approx(lowest, abs=2e-4 * lowest)

    def largest(x: Tensor) -> Tensor:
        t, y, rates = vibration(25, x)
        return Spline.of(t, y, rates=rates).maximum()[0]

    h = 1e-6 * torch.eye(2, dtype=torch.float64)
    slopes = torch.stack([(largest(b + e) - largest(b - e)) / 2e-6 for e in h])
    assert_close(torch.func.jacfwd(largest)(b), slopes, rtol=0, atol=1e-7)


@pytest.mark.parametrize("curvature", [10.0, 100.0])
def test_the_gradient_of_a_peak_is_the_slope_of_its_value(curvature):
    """Peaks of 2,000 random quintics, whose cubics (the start of the search) have theirs elsewhere or none.

    At a place where the slope does not vanish the gradient would be another than that of the value.
    """
    draw = torch.Generator().manual_seed(1)
    t = torch.tensor([0.0, 0.1], dtype=torch.float64)
    scale = torch.tensor([[0.1], [10.0], [curvature]], dtype=torch.float64)
    knots = scale * torch.randn(2_000, 3, 2, generator=draw, dtype=torch.float64)
    knots[:, 1] = torch.stack([knots[:, 1, 0].abs(), -knots[:, 1, 1].abs()], -1)  # up at the start, down at the end
    along = scale * torch.randn(2_000, 3, 2, generator=draw, dtype=torch.float64)

    def highest(x: Tensor) -> Tensor:
        y, m, c = x.unbind(-2)
        return Spline(t, y, m, c).interval_maxima()[:, 0]

    slope = (highest(knots + 1e-7 * along) - highest(knots - 1e-7 * along)) / 2e-7
    assert_close(torch.func.jvp(highest, (knots,), (along,))[1], slope, rtol=1e-5, atol=1e-6)
    assert bool((highest(knots) > knots[:, 0].amax(-1)).all())  # there is a place inside where the curve stands higher


def test_with_known_rates_between_the_samples_at_sixth_order():
    times = torch.linspace(0, 1, 1001, dtype=torch.float64)
    b = torch.tensor([1.3, 0.4], dtype=torch.float64)
    exact = b[0] * torch.sin(30 * times + b[1]) + b[1] * times
    errors = []
    for n in (41, 81):
        t, y, rates = vibration(n, b)
        errors.append(float((Spline.of(t, y, rates=rates).at(times)[0] - exact).abs().max()))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(6.0, abs=0.1)
    assert errors[1] < 1.2e-7
    t, y, rates = vibration(81, b)
    part = Spline.of(t, y, (0.2031, 0.7777), rates=rates)
    inside = times[(times > 0.21) & (times < 0.77)]
    assert_close(part.at(inside), Spline.of(t, y, rates=rates).at(inside), rtol=0, atol=1e-12)
    assert_close(part.at(inside, 2), Spline.of(t, y, rates=rates).at(inside, 2), rtol=0, atol=1e-8)


def test_a_window_is_the_same_curve():
    whole, (first, last) = wave(61), (0.2031, 0.7777)
    part = whole.cut((first, last))
    assert part.t[[0, -1]].tolist() == pytest.approx([first, last])
    times = torch.linspace(first, last, 77, dtype=torch.float64)
    assert_close(part.at(times), whole.at(times), rtol=0, atol=1e-12)
    # Without the peak in it, the larger end is the maximum; with it the same as before.
    _, _, t = exact_peak()
    assert first < t < last
    assert_close(part.maximum(), whole.maximum(), rtol=0, atol=1e-15)
    late = whole.cut((t + 0.1, last))
    assert_close(late.maximum(), whole.at(late.t[:1])[:, 0], rtol=0, atol=1e-12)


def test_a_window_between_two_samples():
    part = wave(11).cut((0.33, 0.36))
    assert part.t.tolist() == pytest.approx([0.33, 0.36])
    assert_close(part.y, wave(11).at(part.t))


def test_the_ends_of_the_motion_are_a_window():
    whole = wave(61)
    assert_close(whole.cut((0.0, 1.0)).y, whole.y, rtol=0, atol=1e-15)
    with refused("window", (0.2, 1.1)):
        whole.cut((0.2, 1.1))
    with refused("time", 1.2):
        whole.sampled(torch.tensor([0.3, 1.2], dtype=torch.float64))


@pytest.mark.parametrize(
    ("y", "expected", "at"),
    [
        ([3.0, 2.0, 1.5, 1.2, 1.1, 1.0], 3.0, 0),
        ([1.0, 1.1, 1.2, 1.5, 2.0, 3.0], 3.0, 5),
        ([2.0, 1.0], 2.0, 0),
    ],
)
def test_a_peak_at_an_end_is_the_end(y, expected, at):
    given = torch.tensor([y], dtype=torch.float64)
    t = torch.linspace(0, 1, len(y), dtype=torch.float64)

    def largest(x: Tensor) -> Tensor:
        return Spline.of(t, x).maximum()[0]

    assert float(largest(given)) == expected
    gradient = torch.func.jacfwd(largest)(given)[0]
    assert gradient.tolist() == [1.0 if i == at else 0.0 for i in range(len(y))]


def test_a_curve_without_a_peak_is_its_value():
    flat = Spline.of(torch.linspace(0, 1, 9, dtype=torch.float64), torch.full((2, 9), -3.0, dtype=torch.float64))
    assert flat.maximum().tolist() == [-3.0, -3.0]
    assert flat.peaks(4).tolist() == [[-3.0] * 4] * 2


def test_the_peak_is_not_beside_the_best_sample():
    """Two peaks of nearly equal height: the best sample belongs to the lower one."""
    t = torch.linspace(0, 2, 41, dtype=torch.float64)
    frequency = 2 * math.pi
    # Peaks at 0.275 (between two samples, higher) and at 1.25 (on a sample, lower).
    late = 1.25
    y = torch.where(t < 1.0, 1.002 * torch.sin(frequency * (t - 0.025)), torch.sin(frequency * (t - late + 0.25)))
    assert abs(float(t[y.argmax()]) - late) < 1e-9
    assert float(Spline.of(t, y[None]).maximum()) == pytest.approx(1.002, abs=1e-4)


def modulated(b: Tensor, n: int = 401) -> Spline:
    """Peaks of different height, three of them about equal for b = 0."""
    t = torch.linspace(0, 1, n, dtype=torch.float64)
    y = torch.sin(5 * 2 * math.pi * t) ** 2 * (1.0 + b[0] * t + b[1] * t * t)
    return Spline.of(t, y[None])


@pytest.mark.thorough
def test_peaks_are_the_highest_local_maxima():
    b = torch.tensor([0.3, -0.1], dtype=torch.float64)
    curve = modulated(b)
    fine = modulated(b, 200_001).y[0]
    inner = fine[1:-1]
    tops = inner[(inner > fine[:-2]) & (inner > fine[2:])].sort(descending=True).values
    assert len(tops) == 10
    assert_close(curve.peaks(6)[0], tops[:6], rtol=0, atol=1e-6)
    assert_close(curve.peaks(1)[:, 0], curve.maximum())
    # Of 10 maxima in 12 rows, the last two are filled from below.
    filled = curve.peaks(12)[0]
    assert_close(filled[:10], tops, rtol=0, atol=1e-6)
    assert float(filled[10:].max()) < 0.2


def test_equal_peaks_keep_their_own_gradients():
    """At b = 0 all peaks are equal: the rows tell ten gradients, the maximum has one of their convex hull."""
    b = torch.zeros(2, dtype=torch.float64)
    rows = torch.func.jacfwd(lambda x: modulated(x).peaks(10)[0])(b)
    times = (torch.arange(10, dtype=torch.float64) + 0.5) / 10
    assert_close(rows[rows[:, 0].argsort()], torch.stack([times, times**2], -1), rtol=0, atol=1e-3)
    one = torch.func.jacfwd(lambda x: modulated(x).maximum()[0])(b)
    assert 0.05 <= float(one[0]) <= 0.95


def test_ends_that_rise_outwards_are_local_maxima():
    t = torch.linspace(0, 1, 101, dtype=torch.float64)
    curve = Spline.of(t, ((t - 0.4) ** 2)[None])
    assert_close(curve.peaks(2)[0], torch.tensor([0.36, 0.16], dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_failed_lane_stays_nan_and_alone():
    """Numbers of a failed lane must not pass for a maximum."""
    alone = wave(61)
    y = alone.y.repeat(2, 1)
    y[1, 30:] = torch.nan
    both = Spline.of(alone.t, y)
    assert_close(both.maximum()[0], alone.maximum()[0])
    assert both.maximum()[1].isnan()
    assert_close(both.peaks(3)[0], alone.peaks(3)[0])
    assert both.cut((0.1, 0.9)).maximum()[1].isnan()


@pytest.mark.parametrize("rates", [None, (torch.zeros(2, 1).double(), torch.zeros(2, 1).double())])
def test_a_state_at_rest_has_one_time(rates):
    """Largest, smallest, mean and last are the value, with its gradient; the integral is over no time."""
    y = torch.tensor([[2.0], [-3.0]], dtype=torch.float64, requires_grad=True)
    curve = Spline.of(torch.tensor([0.5], dtype=torch.float64), y, rates=rates)
    for result in (curve.maximum(), -curve.negative().maximum(), curve.mean(), curve.y[..., -1]):
        assert result.tolist() == [2.0, -3.0]
        assert torch.autograd.grad(result.sum(), y, retain_graph=True)[0].tolist() == [[1.0], [1.0]]
    assert curve.mean(power=2).tolist() == [4.0, 9.0]
    assert curve.integral().tolist() == [0.0, 0.0]


def test_a_single_knot_has_its_value_at_its_time():
    state = Spline.of(torch.zeros(1, dtype=torch.float64), torch.tensor([[3.0], [4.0]], dtype=torch.float64))
    assert state.sampled(torch.zeros(2, dtype=torch.float64)).tolist() == [[3.0, 3.0], [4.0, 4.0]]


@pytest.mark.parametrize(("times", "power"), [([0.0, 0.01], 1), ([0.0, 0.01, 0.02, 0.5, 1.0], 2)])
def test_a_polynomial_at_unequal_times_is_exact(times, power):
    t = torch.tensor(times, dtype=torch.float64)
    curve, between = Spline.of(t, 50.0 * t**power), torch.linspace(0.0, times[-1], 7, dtype=torch.float64)
    assert_close(curve.at(between), 50.0 * between**power)
    assert float(curve.maximum()) == pytest.approx(50.0 * times[-1] ** power)


@pytest.mark.thorough
def test_vmap_and_jvp_of_maxima_without_exact_rates():
    """torch.func.vmap over designs: of curves by differences, of quintics, and forward mode through both."""
    t = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)

    def top(b: Tensor, exact: bool) -> Tensor:
        y = (torch.sin(4.0 * t + b[0]) * b[1])[None]
        rates = (4.0 * b[1] * torch.cos(4.0 * t + b[0]))[None], -16.0 * y
        curve = Spline.of(t, y, (0.1, 0.93), rates if exact else None)
        return torch.cat([curve.maximum(), curve.peaks(2)[0], curve.extremes()[0, 3:5]])

    b = torch.tensor([[0.2, 1.0], [-0.4, 2.0], [2.9, 0.5]], dtype=torch.float64)
    for exact in (True, False):
        expected = torch.stack([top(x, exact) for x in b])
        assert_close(torch.func.vmap(lambda x, exact=exact: top(x, exact))(b), expected, rtol=0, atol=1e-15)
        forward, reverse = (
            torch.func.vmap(jac(lambda x, exact=exact: top(x, exact)))(b)
            for jac in (torch.func.jacfwd, torch.func.jacrev)
        )
        assert_close(forward, reverse, rtol=1e-12, atol=1e-12)
        assert_close(reverse[:2, 0, 1], torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-4)


def test_slopes_of_samples_at_unequal_times():
    """Polynomials of fourth degree inside, of second degree next to the ends, on both sides of a switch."""
    t = torch.tensor([[0.0, 0.1, 0.25, 0.3, 0.42, 0.5, 0.5, 0.61, 0.7, 0.78, 0.9, 1.0]], dtype=torch.float64)
    begins = torch.zeros(1, 12, dtype=torch.bool)
    begins[0, 6] = True
    second = torch.where(begins.cumsum(-1) > 0, -3.0 + t - 2.0 * t**2, t**2)
    slope = torch.where(begins.cumsum(-1) > 0, 1.0 - 4.0 * t, 2.0 * t)
    assert_close(slopes(t, second, begins), slope, rtol=0, atol=1e-13)
    fourth = torch.where(begins.cumsum(-1) > 0, 7.0, t**4)
    assert_close(slopes(t, fourth, begins)[:, [2, 3]], 4.0 * t[:, [2, 3]] ** 3, rtol=0, atol=1e-13)


def test_a_kink_at_a_switch_is_a_peak_where_the_curve_falls_from_it_alone():
    """Straight pieces with equal values on both sides; what is no peak comes after the peaks, from the lowest up."""
    t = torch.tensor([0.0, 1.0, 2.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    begins = t.diff(prepend=t[:1] - 1.0) == 0.0
    for y, peaks in (([0.0, 1.0, 2.0, 2.0, 1.0, 0.0], [2.0, 1.0]), ([0.0, 1.0, 2.0, 2.0, 3.0, 4.0], [4.0, 1.0])):
        curve = Spline.of(t, torch.tensor(y, dtype=torch.float64), begins=begins)
        assert curve.peaks(2).tolist() == pytest.approx(peaks, abs=1e-12)


@pytest.mark.parametrize("exact", [True, False])
def test_a_last_sample_that_is_repeated_counts_once(exact):
    """As of a lane that has fewer states than others: its lowest value, which is the last, fills no row of peaks twice."""
    t = torch.tensor([0.0, 0.2, 0.5, 0.7, 1.0, 1.2], dtype=torch.float64)
    y = torch.stack([3.0 * torch.sin(5.0 * t) - t, -5.0 * t - t**2])
    rates = torch.stack([15.0 * torch.cos(5.0 * t) - 1.0, -5.0 - 2.0 * t])
    second = torch.stack([-75.0 * torch.sin(5.0 * t), torch.full_like(t, -2.0)])
    begins = torch.zeros(2, 6, dtype=torch.bool)

    def measures(again: int) -> Tensor:
        x, z, m, c = (torch.cat([x, x[..., -1:].expand(*x.shape[:-1], again)], -1) for x in (t, y, rates, second))
        marks = torch.nn.functional.pad(begins, (0, again))
        curve = Spline.of(x.expand(z.shape), z, None, (m, c) if exact else None, marks, (0.0, 1.2))
        values, new = curve.samples()
        ends = [curve.maximum(), curve.integral(), curve.integral(2), torch.where(new, values.exp(), 0.0).sum(-1)]
        return torch.cat([torch.stack(ends, -1), curve.peaks(5), curve.extremes()[:, :11]], -1)

    assert_close(measures(3), measures(0), rtol=1e-14, atol=1e-14)


def test_both_values_at_a_switch_are_samples():
    t = torch.tensor([[0.0, 1.0, 1.0, 2.0]], dtype=torch.float64)
    y = torch.tensor([[0.0, 1.0, 5.0, 2.0]], dtype=torch.float64)
    curve = Spline.of(t, y, None, None, torch.tensor([[False, False, True, False]]), (0.0, 2.0))
    assert curve.samples()[1].tolist() == [[True] * 4]
