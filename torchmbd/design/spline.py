"""A sampled history as a smooth curve: between samples, on windows, and at its peaks.

On each interval the quintic with the values, slopes and curvatures of its ends where the history knows them; else the cubic
with slopes at the samples from differences of fourth order (hermite.py). The curve is C1 at least, so its maximum is
differentiable, and continuously so when the peak moves past a sample. The cubic misses the peaks of a vibration sampled
five times per period by half a percent, the quintic by a ten thousandth.

Peaks are located without derivative and evaluated with it: at a maximum the derivative by its time is zero, at an end
the time does not move (envelope theorem), so value and gradient belong together. The gradient taken at the best sample
is 2 % off at 500 samples.
Where a motion passes from phase to phase (integrate/phases/phase.py), a history may jump, at a time that moves with the
design: a `Jump`. Integrals take both of its sides as further samples, so their derivatives hold what the moving jump adds.
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

NEWTON = 10  # steps from the summit of the cubic to that of the quintic
STATIONARY = 1e-6  # slope that counts as none, of the slopes at the ends of an interval
Window = tuple[float, float] | None


class Jump(NamedTuple):
    """Time [lanes] of a jump and the values on its sides [lanes]."""

    t: Tensor
    before: Tensor
    after: Tensor


@dataclass(frozen=True)
class Spline:
    """Knots t [n], increasing; values y, slopes m and curvatures c (None: cubic) [..., n]; jumps between them."""

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
        """Spline of equally spaced samples y [..., n], on a window (t0, t1) of time only.

        rates   first and second derivative by time [..., n] of the samples; None: slopes by differences
        """
        if len(t) < 2:  # a state at rest
            rates = torch.zeros_like(y), torch.zeros_like(y)
        m, c = (_slopes(y) / (t[1] - t[0]), None) if rates is None else rates
        whole = cls(t, y, m, jumps, c)
        return whole if window is None else whole.cut(window)

    @property
    def knots(self) -> tuple[Tensor, ...]:
        """Values and derivatives at the knots."""
        return (self.y, self.m) if self.c is None else (self.y, self.m, self.c)

    def negative(self) -> Spline:
        """The curve with its sign turned, without its jumps."""
        return Spline(self.t, -self.y, -self.m, (), None if self.c is None else -self.c)

    def cut(self, window: tuple[float, float]) -> Spline:
        """The part within a window; its ends become knots."""
        first, last = checked(window)
        rounding = 1e-9 * float(self.t[-1])
        if first < float(self.t[0]) - rounding or last > float(self.t[-1]) + rounding:
            raise InputError(
                f"window is ({first:g}, {last:g}) s; allowed: within the simulated time, "
                f"{float(self.t[0]):g} to {float(self.t[-1]):g} s"
            )
        ends = self.t.new_tensor([first, last]).clamp(self.t[0], self.t[-1])
        inside = torch.nonzero((self.t > ends[0] + rounding) & (self.t < ends[1] - rounding))[:, 0]

        def bounded(x: Tensor, at_ends: Tensor) -> Tensor:
            return torch.cat([at_ends[..., :1], x[..., inside], at_ends[..., 1:]], -1)

        y, m, *c = (bounded(x, self.at(ends, order)) for order, x in enumerate(self.knots))
        return Spline(bounded(self.t, ends), y, m, self.jumps, *c)

    def integral(self, f: Callable[[Tensor], Tensor] = lambda y: y) -> Tensor:
        """Integral of f(y) over time [...], by the trapezoidal rule on the knots and on both sides of the jumps."""
        if not self.jumps:
            return torch.trapezoid(f(self.y), self.t, dim=-1)
        times, values = [], []
        for jump in self.jumps:
            inside = (jump.t > self.t[0]) & (jump.t < self.t[-1])
            times += 2 * [torch.where(inside, jump.t, self.t[0])]  # elsewhere an interval of no length
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
        """Values, or derivatives, at times [k] within the knots: [..., k]."""
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

    def highest(self) -> Tensor:
        """The largest value of every interval [..., n - 1], evaluated with derivative; of a single knot its own."""
        if len(self.t) < 2:
            return self.y
        s, _ = self._summits()
        return self._inside(s)

    def maximum(self) -> Tensor:
        """The largest value [...]; of peaks that are exactly equal the gradient is the mean, a subgradient."""
        return self.highest().amax(-1)

    def peaks(self, count: int) -> Tensor:
        """The `count` highest local maxima, ends included, the highest first: [..., count].

        Where there are fewer, the lowest intervals fill the rows.
        """
        s, local = self._summits()
        tops = self._inside(s)
        rank = torch.argsort(torch.argsort(tops.detach(), -1), -1)
        # Local maxima from the highest down, then everything else from the lowest up.
        score = torch.where(local, rank + len(self.t), -rank)
        order = torch.argsort(score, -1, descending=True)
        return torch.gather(tops, -1, order[..., :count])

    def extremes(self) -> Tensor:
        """The first value, the largest and the smallest of every interval in order of time, and the last [..., 2 n]."""
        places = torch.stack([self._summits()[0], self.negative()._summits()[0]], -1).sort(-1).values
        found = torch.stack([self._inside(s) for s in places.unbind(-1)], -1).flatten(-2)
        return torch.cat([self.y[..., :1], found, self.y[..., -1:]], -1)

    def _inside(self, s: Tensor, derivative: int = 0) -> Tensor:
        """Value or derivative at the share s [..., n - 1] of every interval."""
        ends = [(x[..., :-1], x[..., 1:]) for x in self.knots]
        return hermite(ends, self.t.diff(), s, derivative)

    def _summits(self) -> tuple[Tensor, Tensor]:
        """Where in every interval its largest value is, 0 <= s <= 1, and whether it is a local maximum of the curve."""
        s, local = _Summits.apply(self.t, *self.knots)  # pyright: ignore[reportGeneralTypeIssues]
        return s, local

    def _roots(self) -> tuple[Tensor, Tensor]:
        """Where in every interval the slope vanishes and the curve bends down, and whether there is such a place."""
        h, y0, y1 = self.t.diff(), self.y[..., :-1], self.y[..., 1:]
        m0, m1 = h * self.m[..., :-1], h * self.m[..., 1:]
        a, b = 2.0 * (y0 - y1) + m0 + m1, 3.0 * (y1 - y0) - 2.0 * m0 - m1
        # Slope of the cubic: 3 a s^2 + 2 b s + m0 = 0; of its roots the one with a negative second derivative.
        square = b * b - 3.0 * a * m0
        bend = torch.sqrt(torch.where(square > 0.0, square, 1.0)) - b
        root = torch.where(bend > 0.0, m0 / torch.where(bend > 0.0, bend, 1.0), -1.0)
        inner = (square > 0.0) & (root >= 0.0) & (root < 1.0)
        root = torch.where(inner, root, 0.0)
        return (root, inner) if self.c is None else self._of_quintic(root, inner)

    def _of_quintic(self, root: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
        """The same of the quintic, from those of the cubic.

        Newton's steps inside a bracket where the slope changes its sign from one end to the other: a place where it did not
        vanish would move with the design, and its value have another gradient than the one that stands here. Where the slope
        has one sign at both ends, and steps end elsewhere, the larger end is taken.
        """
        turns = (self.m[..., :-1] > 0.0) & (self.m[..., 1:] < 0.0)
        where = torch.nonzero(turns | inner, as_tuple=True)  # few of all intervals
        ends = [(x[..., :-1][where], x[..., 1:][where]) for x in self.knots]
        h, s, (start, end) = self.t.diff()[where[-1]], root[where], ends[1]
        bracketed, low, high = turns[where], torch.zeros_like(s), torch.ones_like(s)
        s = torch.where(bracketed & ~inner[where], start / torch.where(bracketed, start - end, 1.0), s)
        for _ in range(NEWTON):
            slope, bending = hermite(ends, h, s, 1), hermite(ends, h, s, 2)
            low = torch.where(bracketed & (slope > 0.0), s, low)
            high = torch.where(bracketed & (slope <= 0.0), s, high)
            step = s - slope / torch.where(bending < 0.0, bending, torch.inf) / h
            outside = bracketed & ((step < low) | (step > high) | (bending >= 0.0))
            s = torch.where(outside, 0.5 * (low + high), step.clamp(0.0, 1.0))
        flat = hermite(ends, h, s, 1).abs() <= STATIONARY * torch.maximum(start.abs(), end.abs())
        return root.index_put(where, s), inner.index_put(where, flat)


class _Summits(torch.autograd.Function):
    """Where the summits are: a constant, found without the transforms that follow the derivatives of the curve."""

    @staticmethod
    def forward(t: Tensor, y: Tensor, m: Tensor, c: Tensor | None = None) -> tuple[Tensor, Tensor]:
        curve = Spline(t, y, m, (), c)
        root, inner = curve._roots()
        y0, y1 = y[..., :-1], y[..., 1:]
        inner = inner & (curve._inside(root) >= torch.maximum(y0, y1))
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
        return _Summits.apply(t, *leading), (0, 0)

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> tuple[None, None]:
        return None, None

    @staticmethod
    def backward(ctx: Any, *_: Any) -> tuple[None, None, None, None]:
        return None, None, None, None


def checked(window: tuple[float, float]) -> tuple[float, float]:
    """Two increasing times; InputError for anything else."""
    try:
        first, last = (float(x) for x in window)
    except (TypeError, ValueError) as error:
        raise InputError(f"window is {window!r}; allowed: two times (t0, t1) [s]") from error
    if not 0.0 <= first < last < float("inf"):
        raise InputError(f"window is {window!r}; allowed: 0 <= t0 < t1 [s]")
    return first, last


def _slopes(y: Tensor) -> Tensor:
    """Slopes per sample interval [..., n], of fourth order inside, of second at the ends."""
    if y.shape[-1] < 5:
        return torch.gradient(y, dim=-1)[0]
    first, last = y[..., :3], y[..., -3:]
    forward, backward = y.new_tensor([-1.5, 2.0, -0.5]), y.new_tensor([0.5, -2.0, 1.5])
    inner = (8.0 * (y[..., 3:-1] - y[..., 1:-3]) - (y[..., 4:] - y[..., :-4])) / 12.0
    ends = [
        first @ forward,
        (first[..., 2] - first[..., 0]) / 2.0,
        (last[..., 2] - last[..., 0]) / 2.0,
        last @ backward,
    ]
    return torch.cat([ends[0][..., None], ends[1][..., None], inner, ends[2][..., None], ends[3][..., None]], -1)
