"""A sampled history as a curve of smooth pieces: values between samples, windows, peaks and integrals.

On each interval the curve is the quintic with the values, slopes and curvatures of its ends, if the history has exact rates;
else the cubic with slopes at the samples from differences of fourth order (hermite.py). A piece is at least C1, so its
maximum is differentiable, also where the peak moves past a sample. Of a vibration that is sampled five times per period the
peaks of the cubic are half a percent off, those of the quintic a ten thousandth.

Peaks are located without derivatives, and the curve is differentiated at their fixed positions: at an inner maximum the
derivative with respect to time is zero (envelope theorem). The gradient at the largest sample would be 2 % off at 500
samples.

A history may jump at a switch between two phases of a motion (integrate/phases/phase.py), at a time that depends on the design.
One piece ends there and another begins, with two values at one time. Responses leave out the interval of length zero between
them. The curve has the later value there, a window that begins at a switch the later and one that ends there the
earlier one. Knots that move carry total derivatives, so all derivatives contain the effect of the moving jump.

Where a history bends within an interval (curve.py), the cubic has other slopes before a knot than after it (slopes.py).
Integrals are those of the curve itself, so that they, and their slopes, are continuous where the end of a window passes a knot.
Checked in tests/design/test_spline.py, tests/design/test_switches.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmbd.design.hermite import coefficients, hermite, hermite_integral, polynomial
from torchmbd.design.slopes import ends_of_pieces, slopes, slopes_beside_kinks
from torchmbd.errors import InputError
from torchmbd.math.gradients import wraps

NEWTON = 10  # steps at most from the maximum of the cubic to that of the quintic
SETTLED = 1e-15  # of an interval: a position that moves by less stays where it is
STATIONARY = 1e-6  # slope that is taken as zero, relative to the slopes at the ends of an interval
_NEAR = 0.25  # of a mean interval: samples so near to a switch make differences of rounding errors
_EQUAL = 1e-9  # of the largest value: sides of a switch that are equal
Window = tuple[float, float] | None


@dataclass(frozen=True)
class Spline:
    """A curve through knots.

    t       times of the knots [n], or [..., n] of curves with switches; equal where an interval has no length
    y, m    values and slopes [..., n];   c  curvatures [..., n], or None: cubic
    begins  knots at which a piece begins after a switch [..., n]; None: one piece
    limits  first and last time, which no design moves [s]; None: those of t
    before  slopes before the knots [..., n], m being those after them; None: they are equal
    """

    t: Tensor
    y: Tensor
    m: Tensor
    c: Tensor | None = None
    begins: Tensor | None = None
    limits: tuple[float, float] | None = None
    before: Tensor | None = None

    @classmethod
    def of(
        cls,
        t: Tensor,
        y: Tensor,
        window: Window = None,
        rates: tuple[Tensor, Tensor] | None = None,
        begins: Tensor | None = None,
        limits: tuple[float, float] | None = None,
        kinks: Tensor | None = None,
    ) -> Spline:
        """The spline of samples y [..., n] at times t, on the window (t0, t1) or, by default, on all times.

        rates   first and second derivative with respect to time of the samples [..., n]; None: slopes by differences
        kinks   intervals in which the history is not smooth [..., n - 1], of importance to differences; None: nowhere
        """
        if t.shape[-1] < 2:  # the state of an equilibrium
            rates = torch.zeros_like(y), torch.zeros_like(y)
        if rates is None and begins is not None:
            kept = _kept(_far_from_switches(t.detach(), begins))
            if kinks is not None:
                count = torch.nn.functional.pad(kinks.cumsum(-1), (1, 0))
                kinks = _take(count, kept).diff() > 0
            t, y, begins = _take(t, kept), _take(y, kept), _take(begins, kept) & _first(kept)
        before = None
        if rates is not None:
            m, c = rates
        elif kinks is None:
            m, c = slopes(t, y, begins), None
        else:
            (m, before), c = slopes_beside_kinks(t, y, begins, kinks), None
        curve = cls(t, y, m, c, begins, limits, before)
        return curve if window is None else curve.cut(window)

    @property
    def ends(self) -> list[tuple[Tensor, Tensor]]:
        """Values, slopes and, of the quintic, curvatures at the start and the end of every interval [..., n - 1]."""
        before = self.m if self.before is None else self.before
        pairs = [(self.y, self.y), (self.m, before), *([] if self.c is None else [(self.c, self.c)])]
        return [(x[..., :-1], z[..., 1:]) for x, z in pairs]

    @property
    def _knots(self) -> dict[str, tuple[int, Tensor]]:
        """What the curve has at its knots [..., n] by name, with the order of the derivative."""
        fields = {"y": (0, self.y), "m": (1, self.m), "c": (2, self.c), "before": (1, self.before)}
        return {name: (order, x) for name, (order, x) in fields.items() if x is not None}

    @property
    def span(self) -> tuple[float, float]:
        """First and last time [s]."""
        return self.limits or (float(self.t[0].detach()), float(self.t[-1].detach()))

    @property
    def _lengths(self) -> tuple[Tensor, Tensor]:
        """Lengths of the intervals [n - 1], or [..., n - 1], with 1 instead of zero, and which are not zero."""
        h = self.t.diff()
        real = h.detach() > 0.0
        return torch.where(real, h, 1.0), real

    def negative(self) -> Spline:
        """The negative of the curve."""
        return replace(self, **{name: -x for name, (_, x) in self._knots.items()})

    def cut(self, window: tuple[float, float]) -> Spline:
        """The part within a window, whose ends become knots; InputError for a window outside the knots."""
        first, last = checked_window(window)
        start, end = self.span
        rounding = 1e-9 * end
        if first < start - rounding or last > end + rounding:
            raise InputError(
                "window",
                window,
                f"within the simulated time, {start:g} to {end:g} s",
                state=f"is ({first:g}, {last:g}) s",
            )
        ends = self.t.detach().new_tensor([max(first, start), min(last, end)])
        t = self.t.detach()
        inside = (t > ends[0] + rounding) & (t < ends[1] - rounding)
        kept = _kept(torch.nn.functional.pad(inside, (1, 1), value=True))
        begins = None
        if self.begins is not None:
            begins = _take(torch.nn.functional.pad(self.begins, (1, 1)), kept) & _first(kept)

        def with_ends(x: Tensor, first: Tensor, last: Tensor) -> Tensor:
            return _take(torch.cat([first, x, last], -1), kept)

        def at_ends(order: int) -> tuple[Tensor, Tensor]:
            return self._at(ends[:1], order, rounding), self._at(ends[1:], order, rounding, before=True)

        times = (x.expand(*self.t.shape[:-1], 1) for x in (ends[:1], ends[1:]))
        knots = {name: with_ends(x, *at_ends(order)) for name, (order, x) in self._knots.items()}
        return replace(
            self, t=with_ends(self.t, *times), begins=begins, limits=(float(ends[0]), float(ends[1])), **knots
        )

    def integral(self, power: int = 1) -> Tensor:
        """Integral over time [...] of the curve, or of its square: power 2."""
        return hermite_integral(self.ends, self.t.diff(), power).sum(-1)

    def mean(self, power: int = 1) -> Tensor:
        """Mean over time [...] of the curve, or of its square: power 2."""
        if self.t.shape[-1] < 2:
            return self.y[..., 0] ** power
        return self.integral(power) / self.duration

    @property
    def duration(self) -> Tensor:
        """Length of the curve [s], [] or [...]."""
        return self.t[..., -1] - self.t[..., 0]

    def at(self, times: Tensor, derivative: int = 0) -> Tensor:
        """Values, or time derivatives, at times [k], or [..., k], within the knots: [..., k]; at a switch the later ones."""
        return self._at(times, derivative)

    def _at(self, times: Tensor, derivative: int = 0, rounding: float = 0.0, before: bool = False) -> Tensor:
        """As `at`; before: at a switch the earlier values. A switch is at a time if it is nearer than `rounding`."""
        n = self.t.shape[-1]
        if n < 2:
            knots = [self.y, self.m, self.c]
            return knots[derivative].expand(*self.y.shape[:-1], times.shape[-1])
        t, where = self.t.detach(), times.detach() + (-rounding if before else rounding)
        if t.dim() > 1:
            where = where.expand(*t.shape[:-1], where.shape[-1])
        start = torch.searchsorted(t.contiguous(), where.contiguous(), right=not before) - 1
        start = start.clamp(0, n - 2)
        h, _ = self._lengths
        ends = [(_take(x, start), _take(z, start)) for x, z in self.ends]
        h = _take(h, start)
        return hermite(ends, h, (times - _take(self.t, start)) / h, derivative)

    def sampled(self, times: Tensor) -> Tensor:
        """Values at times [k]: [..., k]; InputError outside the knots."""
        start, end = self.span
        rounding = 1e-9 * end
        if float(times.min()) < start - rounding or float(times.max()) > end + rounding:
            wrong = float(times.max()) if float(times.max()) > end else float(times.min())
            raise InputError("time", wrong, f"within the simulated time, {start:g} to {end:g} s", shown=f"{wrong:g} s")
        return self._at(times, rounding=rounding)

    def spaced(self, count: int) -> Tensor:
        """Values at equally spaced times from the first to the last: [..., count]; the times move with the ends."""
        share = torch.linspace(0.0, 1.0, count, dtype=self.t.dtype)
        return self.at(self.t[..., :1] + self.duration[..., None] * share)

    def samples(self) -> tuple[Tensor, Tensor]:
        """Values at the knots [..., n], and which of them are not repetitions of the one before."""
        new = self.t.detach().diff() > 0.0
        if self.begins is not None:
            new = new | self.begins[..., 1:]
        return self.y, torch.nn.functional.pad(new, (1, 0), value=True)

    def interval_maxima(self) -> Tensor:
        """The largest value of every interval [..., n - 1]; the value of a single knot [..., 1]."""
        if self.t.shape[-1] < 2:
            return self.y
        return self._at_positions(self._plain._maximum_positions()[0])

    def maximum(self) -> Tensor:
        """The largest value [...]; of peaks that are exactly equal the gradient is the mean, a subgradient."""
        return self.interval_maxima().amax(-1)

    def peaks(self, count: int) -> Tensor:
        """The `count` highest local maxima, ends included, the highest first: [..., count].

        If there are fewer, the maxima of the lowest intervals follow.
        """
        s, inner = self._plain._maximum_positions()
        starts, ends = self._plain._ends_that_are_maxima()
        local = inner | (starts & (s == 0.0)) | (ends & (s == 1.0))
        tops = self._at_positions(s)
        rank = torch.argsort(torch.argsort(tops.detach(), -1), -1)
        # Local maxima from the highest down, then all other intervals from the lowest up, then those without length.
        n = self.t.shape[-1]
        score = torch.where(local, rank + n, torch.where(self._lengths[1], -rank, -rank - n))
        order = torch.argsort(score, -1, descending=True)
        return torch.gather(tops, -1, order[..., :count])

    def extremes(self) -> Tensor:
        """The first value, the largest and the smallest of every interval in order of time, and the last [..., 2 n]."""
        both = [curve._maximum_positions()[0] for curve in (self._plain, self._plain.negative())]
        positions = torch.stack(both, -1).sort(-1).values
        inner = torch.stack([self._at_positions(s) for s in positions.unbind(-1)], -1).flatten(-2)
        return torch.cat([self.y[..., :1], inner, self.y[..., -1:]], -1)

    def _at_positions(self, s: Tensor) -> Tensor:
        """Value at the position s, 0 to 1, in every interval [..., n - 1]."""
        return hermite(self.ends, self._lengths[0], s)

    @property
    def _plain(self) -> Spline:
        """The curve by constants: neither autograd nor torch.func differentiates a search for its peaks."""
        return replace(self, t=self.t.detach(), **{name: x.detach() for name, (_, x) in self._knots.items()})

    def _maximum_positions(self) -> tuple[Tensor, Tensor]:
        """Position of the largest value in every interval, 0 to 1, and whether the slope is zero there."""
        root, inner = self._stationary_positions()
        y0, y1 = self.y[..., :-1], self.y[..., 1:]
        inner = inner & self._lengths[1] & (self._at_positions(root) >= torch.maximum(y0, y1))
        return torch.where(inner, root, (y1 > y0).to(y0.dtype)), inner

    def _ends_that_are_maxima(self) -> tuple[Tensor, Tensor]:
        """At which intervals the curve, or a piece of it, has a local maximum at the start or at the end [..., n - 1].

        Of a switch with equal values on both sides, the end of the earlier piece stands for both.
        """
        y, m, (_, real), (first, last) = self.y, self.m, self._lengths, self.ends[1]
        i = torch.arange(real.shape[-1]).expand(real.shape)
        before = torch.nn.functional.pad(torch.where(real, i + 1, 0).cummax(-1).values[..., :-1], (1, 0))
        after = torch.where(real, i, real.shape[-1]).flip(-1).cummin(-1).values.flip(-1)
        after = torch.nn.functional.pad(after[..., 1:], (0, 1), value=real.shape[-1])
        equal = _EQUAL * y.abs().amax(-1, keepdim=True)
        start = (before == 0) | (before != i) & (y[..., :-1] > _take(y, before) + equal)
        rise = y[..., 1:] - _take(y, after)
        end = (after == real.shape[-1]) | (after != i + 1) & (
            (rise > equal) | (rise.abs() <= equal) & (_take(m, after) <= 0.0)
        )
        start, end = real & start & (first <= 0.0), real & end & (last >= 0.0)
        if self.before is None:
            return start, end
        falls = torch.nn.functional.pad(first[..., 1:], (0, 1)) < 0.0  # after the knot at the end of an interval
        flat = STATIONARY * first.abs().amax(-1, keepdim=True)
        kink = (self.before != m)[..., 1:] & falls & (last >= -flat)
        return start, end | real & kink

    def _stationary_positions(self) -> tuple[Tensor, Tensor]:
        """Position in every interval where the slope is zero and the curvature negative, and whether there is one."""
        h, y0, y1 = self._lengths[0], self.y[..., :-1], self.y[..., 1:]
        m0, m1 = (h * x for x in self.ends[1])
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
        ends = self.ends
        bracketed = (ends[1][0] > 0.0) & (ends[1][1] < 0.0)
        searched = bracketed | inner
        at_ends = [x for pair in ends for x in pair]
        of_intervals = torch.broadcast_tensors(root, bracketed, inner, self._lengths[0], *at_ends)
        if wraps(searched):
            s, flat = _root(*of_intervals)
        else:  # few intervals are searched
            s, flat = root.clone(), inner.clone()
            s[searched], flat[searched] = _root(*(x[searched] for x in of_intervals))
        return torch.where(searched, s, root), torch.where(searched, flat, inner)


def _root(root: Tensor, bracketed: Tensor, inner: Tensor, h: Tensor, *knots: Tensor) -> tuple[Tensor, Tensor]:
    """Where the slope of each quintic is zero, and whether it is: Newton's steps from the root of the cubic.

    knots: value, value, slope, slope, curvature, curvature at both ends
    """
    start, end = knots[2:4]
    _, *terms = coefficients(list(zip(knots[::2], knots[1::2], strict=True)), h).unbind(0)
    by_s = [k * x for k, x in enumerate(terms, 1)]  # the slope in units of s
    by_s_s = [k * x for k, x in enumerate(by_s[1:], 1)]
    low, high = torch.zeros_like(root), torch.ones_like(root)
    s = torch.where(bracketed & ~inner, start / torch.where(bracketed, start - end, 1.0), root)
    for _ in range(NEWTON):
        slope, curvature = polynomial(by_s, s), polynomial(by_s_s, s)
        low = torch.where(bracketed & (slope > 0.0), s, low)
        high = torch.where(bracketed & (slope <= 0.0), s, high)
        step = s - slope / torch.where(curvature < 0.0, curvature, torch.inf)
        outside = bracketed & ((step < low) | (step > high) | (curvature >= 0.0))
        new = torch.where(outside, 0.5 * (low + high), step.clamp(0.0, 1.0))
        moves = (new - s).abs() > SETTLED
        s = torch.where(moves, new, s)  # none depends on how long others move
        if not (wraps(moves) or bool(moves.any())):
            break
    return s, polynomial(by_s, s).abs() <= STATIONARY * h * torch.maximum(start.abs(), end.abs())


def checked_window(window: tuple[float, float]) -> tuple[float, float]:
    """The window as two floats, increasing; InputError for other values."""
    try:
        first, last = (float(x) for x in window)
    except (TypeError, ValueError) as error:
        raise InputError("window", window, "two times (t0, t1) [s]") from error
    if not 0.0 <= first < last < float("inf"):
        raise InputError("window", window, "must satisfy 0 <= t0 < t1 [s]")
    return first, last


def _far_from_switches(t: Tensor, begins: Tensor) -> Tensor:
    """Which knots [..., n] are ends of pieces, or not too near to these for differences."""
    first, last = ends_of_pieces(t, begins)
    i, near = torch.arange(t.shape[-1]), _NEAR * (t[..., -1:] - t[..., :1]) / (t.shape[-1] - 1)
    far = (t - t.gather(-1, first) > near) & (t.gather(-1, last) - t > near)
    return far | (i == first) | (i == last)


def _kept(mask: Tensor) -> Tensor:
    """Numbers of the knots of a mask [n] or [..., n], in order; rows that have fewer than others repeat their last one.

    Under torch.func.vmap all rows have as many as there are knots.
    """
    if mask.dim() == 1:
        return torch.nonzero(mask)[:, 0]
    order = torch.argsort((~mask).to(torch.int8), dim=-1, stable=True)
    count = mask.sum(-1, keepdim=True)
    return order.gather(-1, torch.arange(mask.shape[-1]).minimum(count - 1))


def _first(kept: Tensor) -> Tensor:
    """Which of these numbers are not repetitions of the one before."""
    return torch.nn.functional.pad(kept.diff() > 0, (1, 0), value=True)


def _take(x: Tensor, index: Tensor) -> Tensor:
    """Entries of x [n] or [..., n]: index [k] for all rows, or [..., k]."""
    if index.dim() == 1:
        return x[..., index]
    return x.expand(*index.shape[:-1], x.shape[-1]).gather(-1, index)
