"""A sampled history as a smooth curve: values between samples, windows, peaks and integrals.

On each interval the curve is the quintic with the values, slopes and curvatures of its ends, if the history has exact rates;
else the cubic with slopes at the samples from differences of fourth order (hermite.py). The curve is at least C1, so its
maximum is differentiable, also where the peak moves past a sample. Of a vibration that is sampled five times per period the
peaks of the cubic are half a percent off, those of the quintic a ten thousandth.

Peaks are located without derivatives, and the curve is differentiated at their fixed times: at an inner maximum the derivative
by time is zero, and an end of the curve does not move (envelope theorem). The gradient at the largest sample would be 2 % off
at 500 samples.
Where a motion passes from phase to phase (integrate/phases/phase.py), a history may jump, at a time that depends on the design:
a `Jump`. Integrals use both sides of it as further samples, so their derivatives contain the effect of the moving jump.
Checked in tests/design/test_spline.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.design.hermite import hermite
from torchmbd.errors import InputError

NEWTON = 10  # steps from the maximum of the cubic to that of the quintic
STATIONARY = 1e-6  # slope that is taken as zero, relative to the slopes at the ends of an interval
Window = tuple[float, float] | None


class Jump(NamedTuple):
    """Time [lanes] of a jump and the values on its sides [lanes]."""

    t: Tensor
    before: Tensor
    after: Tensor


@dataclass(frozen=True)
class Spline:
    """A curve through knots.

    t      times of the knots, increasing [n]
    y, m   values and slopes [..., n];   c  curvatures [..., n], or None: cubic
    jumps  between knots; only integrals use them
    """

    t: Tensor
    y: Tensor
    m: Tensor
    jumps: tuple[Jump, ...] = ()
    c: Tensor | None = None

    @classmethod
    def of(
        cls,
        t: Tensor,
        y: Tensor,
        window: Window = None,
        jumps: tuple[Jump, ...] = (),
        rates: tuple[Tensor, Tensor] | None = None,
    ) -> Spline:
        """The spline of samples y [..., n] at times t [n], on the window (t0, t1) or, by default, on all times.

        rates   first and second derivative by time of the samples [..., n]; None: slopes by differences
        """
        if len(t) < 2:  # the state of an equilibrium
            rates = torch.zeros_like(y), torch.zeros_like(y)
        m, c = (_slopes(t, y), None) if rates is None else rates
        curve = cls(t, y, m, jumps, c)
        return curve if window is None else curve.cut(window)

    @property
    def knots(self) -> tuple[Tensor, ...]:
        """Values, slopes and, of the quintic, curvatures at the knots [..., n]."""
        return (self.y, self.m) if self.c is None else (self.y, self.m, self.c)

    def negative(self) -> Spline:
        """The negative of the curve, without jumps."""
        return Spline(self.t, -self.y, -self.m, (), None if self.c is None else -self.c)

    def cut(self, window: tuple[float, float]) -> Spline:
        """The part within a window, whose ends become knots; InputError for a window outside the knots."""
        first, last = checked_window(window)
        rounding = 1e-9 * float(self.t[-1])
        if first < float(self.t[0]) - rounding or last > float(self.t[-1]) + rounding:
            raise InputError(
                f"window is ({first:g}, {last:g}) s; allowed: within the simulated time, "
                f"{float(self.t[0]):g} to {float(self.t[-1]):g} s"
            )
        ends = self.t.new_tensor([first, last]).clamp(self.t[0], self.t[-1])
        inside = torch.nonzero((self.t > ends[0] + rounding) & (self.t < ends[1] - rounding))[:, 0]

        def with_ends(x: Tensor, at_ends: Tensor) -> Tensor:
            return torch.cat([at_ends[..., :1], x[..., inside], at_ends[..., 1:]], -1)

        y, m, *c = (with_ends(x, self.at(ends, order)) for order, x in enumerate(self.knots))
        return Spline(with_ends(self.t, ends), y, m, self.jumps, *c)

    def integral(self, f: Callable[[Tensor], Tensor] = lambda y: y) -> Tensor:
        """Integral of f(y) over time [...], by the trapezoidal rule on the knots and on both sides of the jumps."""
        if not self.jumps:
            return torch.trapezoid(f(self.y), self.t, dim=-1)
        times, values = [], []
        for jump in self.jumps:
            inside = (jump.t > self.t[0]) & (jump.t < self.t[-1])
            times += 2 * [torch.where(inside, jump.t, self.t[0])]  # outside: an interval of length zero
            values += [f(jump.before), f(jump.after)]
        t = torch.cat([torch.stack(times, -1), self.t.expand_as(self.y)], -1)
        y = torch.cat([torch.stack(values, -1), f(self.y)], -1)
        order = torch.argsort(t.detach(), dim=-1, stable=True)
        return torch.trapezoid(y.gather(-1, order), t.gather(-1, order), dim=-1)

    def mean(self, f: Callable[[Tensor], Tensor] = lambda y: y) -> Tensor:
        """Mean of f(y) over time [...]."""
        if len(self.t) < 2:
            return f(self.y)[..., 0]
        return self.integral(f) / (self.t[-1] - self.t[0])

    def at(self, times: Tensor, derivative: int = 0) -> Tensor:
        """Values, or derivatives by time, at times [k] within the knots: [..., k]."""
        if len(self.t) < 2:
            return self.knots[derivative].expand(*self.y.shape[:-1], len(times))
        start = (torch.searchsorted(self.t, times, right=True) - 1).clamp(0, len(self.t) - 2)
        h = self.t[start + 1] - self.t[start]
        ends = [(x[..., start], x[..., start + 1]) for x in self.knots]
        return hermite(ends, h, (times - self.t[start]) / h, derivative)

    def sampled(self, times: Tensor) -> Tensor:
        """Values at times [k]: [..., k]; InputError outside the knots."""
        rounding = 1e-9 * float(self.t[-1])
        if float(times.min()) < float(self.t[0]) - rounding or float(times.max()) > float(self.t[-1]) + rounding:
            wrong = float(times.max()) if float(times.max()) > float(self.t[-1]) else float(times.min())
            raise InputError(
                f"time is {wrong:g} s; allowed: within the simulated time, {float(self.t[0]):g} to {float(self.t[-1]):g} s"
            )
        return self.at(times)

    def interval_maxima(self) -> Tensor:
        """The largest value of every interval [..., n - 1]; the value of a single knot [..., 1]."""
        if len(self.t) < 2:
            return self.y
        s, _ = self._maximum_positions()
        return self._at_positions(s)

    def maximum(self) -> Tensor:
        """The largest value [...]; of peaks that are exactly equal the gradient is the mean, a subgradient."""
        return self.interval_maxima().amax(-1)

    def peaks(self, count: int) -> Tensor:
        """The `count` highest local maxima, ends included, the highest first: [..., count].

        If there are fewer, the maxima of the lowest intervals follow.
        """
        s, local = self._maximum_positions()
        tops = self._at_positions(s)
        rank = torch.argsort(torch.argsort(tops.detach(), -1), -1)
        # Local maxima from the highest down, then everything else from the lowest up.
        score = torch.where(local, rank + len(self.t), -rank)
        order = torch.argsort(score, -1, descending=True)
        return torch.gather(tops, -1, order[..., :count])

    def extremes(self) -> Tensor:
        """The first value, the largest and the smallest of every interval in order of time, and the last [..., 2 n]."""
        positions = (
            torch.stack([self._maximum_positions()[0], self.negative()._maximum_positions()[0]], -1).sort(-1).values
        )
        inner = torch.stack([self._at_positions(s) for s in positions.unbind(-1)], -1).flatten(-2)
        return torch.cat([self.y[..., :1], inner, self.y[..., -1:]], -1)

    def _at_positions(self, s: Tensor, derivative: int = 0) -> Tensor:
        """Value or derivative at the position s, 0 to 1, in every interval [..., n - 1]."""
        ends = [(x[..., :-1], x[..., 1:]) for x in self.knots]
        return hermite(ends, self.t.diff(), s, derivative)

    def _maximum_positions(self) -> tuple[Tensor, Tensor]:
        """Position of the largest value in every interval, 0 to 1, and whether it is a local maximum of the curve."""
        s, local = _MaximumPositions.apply(self.t, *self.knots)  # pyright: ignore[reportGeneralTypeIssues]
        return s, local

    def _stationary_positions(self) -> tuple[Tensor, Tensor]:
        """Position in every interval where the slope is zero and the curvature negative, and whether there is one."""
        h, y0, y1 = self.t.diff(), self.y[..., :-1], self.y[..., 1:]
        m0, m1 = h * self.m[..., :-1], h * self.m[..., 1:]
        a, b = 2.0 * (y0 - y1) + m0 + m1, 3.0 * (y1 - y0) - 2.0 * m0 - m1
        # Slope of the cubic: 3 a s^2 + 2 b s + m0 = 0; of its roots the one with a negative second derivative.
        square = b * b - 3.0 * a * m0
        divisor = torch.sqrt(torch.where(square > 0.0, square, 1.0)) - b
        root = torch.where(divisor > 0.0, m0 / torch.where(divisor > 0.0, divisor, 1.0), -1.0)
        inner = (square > 0.0) & (root >= 0.0) & (root < 1.0)
        root = torch.where(inner, root, 0.0)
        return (root, inner) if self.c is None else self._of_quintic(root, inner)

    def _of_quintic(self, root: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
        """Stationary positions of the quintic, from those of the cubic.

        If the slope is positive at the start of an interval and negative at its end, Newton's steps stay inside a bracket of
        the root: the gradient of the maximum assumes that the slope is zero there. Else the steps may end where the slope is
        not zero; the interval then has no stationary position.
        """
        changes_sign = (self.m[..., :-1] > 0.0) & (self.m[..., 1:] < 0.0)
        where = torch.nonzero(changes_sign | inner, as_tuple=True)  # few of all intervals
        ends = [(x[..., :-1][where], x[..., 1:][where]) for x in self.knots]
        h, s, (start, end) = self.t.diff()[where[-1]], root[where], ends[1]
        bracketed, low, high = changes_sign[where], torch.zeros_like(s), torch.ones_like(s)
        s = torch.where(bracketed & ~inner[where], start / torch.where(bracketed, start - end, 1.0), s)
        for _ in range(NEWTON):
            slope, curvature = hermite(ends, h, s, 1), hermite(ends, h, s, 2)
            low = torch.where(bracketed & (slope > 0.0), s, low)
            high = torch.where(bracketed & (slope <= 0.0), s, high)
            step = s - slope / torch.where(curvature < 0.0, curvature, torch.inf) / h
            outside = bracketed & ((step < low) | (step > high) | (curvature >= 0.0))
            s = torch.where(outside, 0.5 * (low + high), step.clamp(0.0, 1.0))
        flat = hermite(ends, h, s, 1).abs() <= STATIONARY * torch.maximum(start.abs(), end.abs())
        return root.index_put(where, s), inner.index_put(where, flat)


class _MaximumPositions(torch.autograd.Function):
    """Positions of the interval maxima as constants: autograd and torch.func do not differentiate the search."""

    @staticmethod
    def forward(t: Tensor, y: Tensor, m: Tensor, c: Tensor | None = None) -> tuple[Tensor, Tensor]:
        curve = Spline(t, y, m, (), c)
        root, inner = curve._stationary_positions()
        y0, y1 = y[..., :-1], y[..., 1:]
        inner = inner & (curve._at_positions(root) >= torch.maximum(y0, y1))
        s = torch.where(inner, root, (y1 > y0).to(y0.dtype))
        local = inner.clone()
        local[..., 0] |= (s[..., 0] == 0.0) & (m[..., 0] <= 0.0)
        local[..., -1] |= (s[..., -1] == 1.0) & (m[..., -1] >= 0.0)
        return s, local

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, t: Tensor, *knots: Tensor) -> tuple:
        leading = (
            x[None].expand(info.batch_size, *x.shape) if d is None else x.movedim(d, 0)
            for x, d in zip(knots, in_dims[1:], strict=True)
        )
        return _MaximumPositions.apply(t, *leading), (0, 0)

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> tuple[None, None]:
        return None, None

    @staticmethod
    def backward(ctx: Any, *_: Any) -> tuple[None, None, None, None]:
        return None, None, None, None


def checked_window(window: tuple[float, float]) -> tuple[float, float]:
    """The window as two floats, increasing; InputError for other values."""
    try:
        first, last = (float(x) for x in window)
    except (TypeError, ValueError) as error:
        raise InputError(f"window is {window!r}; allowed: two times (t0, t1) [s]") from error
    if not 0.0 <= first < last < float("inf"):
        raise InputError(f"window is {window!r}; allowed: 0 <= t0 < t1 [s]")
    return first, last


def _slopes(t: Tensor, y: Tensor) -> Tensor:
    """Slopes at samples [..., n]: of fourth order inside and second order at the ends; at unequal times of second order."""
    h = t.diff()
    if float((h - h[0]).abs().max()) > 1e-6 * float(h[0]):
        return torch.gradient(y, spacing=(t,), dim=-1, edge_order=min(2, len(t) - 1))[0]
    if len(t) < 5:
        return torch.gradient(y, dim=-1)[0] / h[0]
    forward, backward = y.new_tensor([-1.5, 2.0, -0.5]), y.new_tensor([0.5, -2.0, 1.5])
    start, end = y[..., :3] @ forward, y[..., -3:] @ backward
    second, last_but_one = (y[..., 2] - y[..., 0]) / 2.0, (y[..., -1] - y[..., -3]) / 2.0
    inner = (8.0 * (y[..., 3:-1] - y[..., 1:-3]) - (y[..., 4:] - y[..., :-4])) / 12.0
    first_two, last_two = torch.stack([start, second], -1), torch.stack([last_but_one, end], -1)
    return torch.cat([first_two, inner, last_two], -1) / h[0]
