"""Events that are shorter than a step: the function g of an event passes zero twice between ends at which its sign is the same.

    p(s), 0 <= s <= 1     the cubic of g and its rate g' at both ends (Hermite)
    p'(s) = 0             where g turns in the step, as the cubic has it; there the state is integrated, and g evaluated

If g has not passed zero there, the half in which its rate changes its sign is looked at in the same way. An event that begins
where another one has just ended (a bounce) has g = 0 at its begin: then g turns away from zero and comes back through it.
Only what was evaluated counts: the cubic says where to look. Where it misses g by more than the distance of g from zero, the
steps are too long to know.
Checked in tests/integrate/phases/test_short_events.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.lanes import join_states, lanes_of, pick_lanes, pick_states
from torchmbd.integrate.phases.event_rounding import EventRounding
from torchmbd.integrate.phases.events import DIRECTIONS, ROUNDING, Event, Views
from torchmbd.integrate.phases.phase_record import PhaseRecord
from torchmbd.integrate.phases.regular_steps import RegularSteps
from torchmbd.multibody.equations import equations
from torchmbd.results.state import State

_AT_ONCE = 64  # steps that are looked at together, at least
_LOOKS = 4  # of a step, each at the turn of a shorter cubic
# A function that is farther from zero than so many times its change in this step and the one before does not reach it.
FAR = 4.0


@dataclass
class ShortEvents:
    """Where lanes pass zero in a step, as sizes from its begin [lanes].

    mask      which lanes do
    low, high enclose the event;  g_low, g_high: the function there;  size: an estimate
    unclear   lanes in which the steps are too long to know
    """

    mask: Tensor
    low: Tensor
    high: Tensor
    g_low: Tensor
    g_high: Tensor
    size: Tensor
    unclear: Tensor

    def select(self, steps: Tensor) -> ShortEvents:
        """Those of some steps (a mask)."""
        return ShortEvents(*(getattr(self, f.name)[steps] for f in fields(self)))

    def joined(self, other: ShortEvents) -> ShortEvents:
        """Those of other lanes as well; of each lane zeros stand in one of both."""
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return ShortEvents(*(a | b if a.dtype == torch.bool else a + b for a, b in pairs))

    def in_lanes(self, lanes: list[int], count: int) -> ShortEvents:
        """The same, where these are some of so many lanes."""

        def wide(x: Tensor) -> Tensor:
            return x.new_zeros(count).index_copy(0, torch.tensor(lanes), x)

        return ShortEvents(*(wide(getattr(self, f.name)) for f in fields(self)))


def near_zero(before: Tensor, after: Tensor, change: Tensor) -> Tensor:
    """True if a function may reach zero in a step, from its values at both ends and its change in the step before."""
    return torch.minimum(before.abs(), after.abs()) <= FAR * (after - before).abs().maximum(change)


@dataclass
class ShortEventSearch:
    """Looks for them in the steps of one phase, in many steps at once: each is a lane of its own."""

    event: Event
    record: PhaseRecord
    integrator: Integrator
    views: Views
    times: Tensor

    def __post_init__(self) -> None:
        h = float(self.times[1] - self.times[0])
        self.rounding = EventRounding(self.event, self.views, self.record.dynamics, h)

    def counted(self, steps: RegularSteps, mask: Tensor, g: Tensor) -> Tensor:
        """Those among steps of lanes (a mask [lanes, steps]) at whose ends the function is more than rounding.

        g   the function at the ends of the steps [lanes, points]
        """
        result = torch.zeros_like(mask)
        for k, lanes, t, x in self._parts(steps, mask):
            whole = [self.record.whole(y.values(), at) for y, at in zip(x, t, strict=True)]
            values = torch.stack([g[lanes, k], g[lanes, k + 1]])
            result[lanes, k] = self.rounding.exceeded(lanes.tolist(), t, (whole[0], whole[1]), values)
        return result

    def in_regular_steps(
        self, steps: RegularSteps, inside: Tensor, g: Tensor, change: Tensor, passed: Tensor
    ) -> dict[int, ShortEvents]:
        """Those of lanes `inside` (a mask), by the number of the step, 1 the first, of all lanes.

        g, change   the function at the ends of the steps [lanes, points], and how much it changed before them
        passed      steps in which it passes zero once [lanes, steps]
        """
        before, after = g[:, :-1], g[:, 1:]
        near = near_zero(before, after, change[:, :-1]) & ~passed.cumsum(1).bool() & inside[:, None]
        result: dict[int, ShortEvents] = {}
        for k, lanes, (t, t1), ends in self._parts(steps, self.counted(steps, near, g)):
            events = self.in_steps(lanes.tolist(), t, t1 - t, ends, (before[lanes, k], after[lanes, k]))
            for i in k.unique().tolist():
                of_step = events.select(k == i).in_lanes(lanes[k == i].tolist(), len(inside))
                result[i + 1] = result[i + 1].joined(of_step) if i + 1 in result else of_step
        return result

    def _parts(
        self, steps: RegularSteps, mask: Tensor
    ) -> Iterator[tuple[Tensor, Tensor, tuple[Tensor, Tensor], tuple[State, State]]]:
        """Steps of lanes (a mask [lanes, steps]), some at a time: their numbers, lanes [m], times and states at both ends."""
        pairs = torch.nonzero(mask.T)
        for part in pairs.split(max(len(mask), _AT_ONCE)) if len(pairs) else ():
            k, lanes = part.unbind(1)
            some = [(i, lanes[k == i].tolist()) for i in k.unique().tolist()]
            first, last = (
                join_states([pick_states(steps.state(steps.first + i + j), at) for i, at in some]) for j in (0, 1)
            )
            yield k, lanes, (self.times[steps.first + k][None], self.times[steps.first + k + 1][None]), (first, last)

    def in_steps(
        self, lanes: list[int], t: Tensor, h: Tensor, ends: tuple[State, State], g: tuple[Tensor, Tensor]
    ) -> ShortEvents:
        """Those in steps of lanes [m] from t [1, m] to t + h, at whose ends are condensed states and values of the function.

        A lane may make several of the steps.
        """
        dynamics, condensed = (lanes_of(d, lanes).values() for d in (self.record.dynamics, self.record.condensed))
        every, begin, end = list(range(len(lanes))), t, t + h
        start, both, times = ends[0].values(), join_states(ends).values(), torch.cat([begin, end], -1)
        both = self.record.whole(both, times)

        def rates(some: list[int], t: Tensor, x: State) -> tuple[Tensor, Tensor]:
            """The function and its rate."""
            still = torch.zeros_like(x.vd)  # an event reads positions and rates alone
            slopes = State(
                equations.coordinate_rates(dynamics.topology, x.q, x.v), x.vd, still, still, torch.zeros_like(x.lam)
            )
            return self.views.rates(self.event, [lanes[i] for i in some], lanes_of(dynamics, some), t, x, slopes)

        def look(size: Tensor, some: list[int]) -> tuple[Tensor, Tensor]:
            t = pick_lanes(begin, some) + size
            x = self.integrator.step_of_size(lanes_of(condensed, some), pick_states(start, some), size[None], t)
            return rates(some, t, self.record.whole(x, t))

        at_start, at_end = rates(every + every, times, both)[1].chunk(2)
        return short_events(self.event, h[0], g, (at_start, at_end), look)


def short_events(
    event: Event,
    h: Tensor,
    g: tuple[Tensor, Tensor],
    rates: tuple[Tensor, Tensor],
    look: Callable[[Tensor, list[int]], tuple[Tensor, Tensor]],
) -> ShortEvents:
    """Events in steps of sizes h, from the function and its rates at both ends; all [lanes].

    look   gives the function and its rate in some of the steps, at these sizes
    """
    begins_at_zero = g[0].abs() <= ROUNDING * g[1].abs()
    sign = torch.where(begins_at_zero, rates[0], g[0]).sign()
    returns = begins_at_zero & (sign * g[1] < 0.0)
    way = torch.where(returns, sign, -sign)  # in which g turns: away from zero, or towards it
    open_lanes = returns | (~begins_at_zero & (sign * g[1] > 0.0))
    a, b, (ga, gb), (ra, rb) = torch.zeros_like(h), h, g, rates
    result = ShortEvents(torch.zeros_like(returns), a, h, *g, 0.5 * h, torch.zeros_like(returns))
    direction = DIRECTIONS[event.direction]
    for count in range(_LOOKS):
        s, p = _turn(ga, ra * (b - a), gb, rb * (b - a), way)
        open_lanes = open_lanes & torch.isfinite(s)
        if not bool(open_lanes.any()):
            break
        size, some = a + torch.where(open_lanes, s, 0.5) * (b - a), torch.nonzero(open_lanes)[:, 0]
        seen = look(size[some], some.tolist())
        gm, rm = (torch.full_like(size, torch.nan).index_copy(0, some, x) for x in seen)
        if not count:
            result.unclear = open_lanes & ((gm - p).abs() > gm.abs())
        crossed = open_lanes & (way * gm >= 0.0) & (gm != 0.0)
        leaves = (direction == 0) | (sign == -direction)  # whether going through zero from the sign at the begin counts
        first = crossed & ~returns & leaves
        second = crossed & ~first & (leaves | ~returns)
        _put(result, first, torch.zeros_like(h), size, g[0], gm)
        _put(result, second, size, h, gm, g[1])
        open_lanes = open_lanes & ~crossed
        right = way * rm > 0.0  # g still goes on
        a, ga, ra = (torch.where(right, x, y) for x, y in ((size, a), (gm, ga), (rm, ra)))
        b, gb, rb = (torch.where(right, y, x) for x, y in ((size, b), (gm, gb), (rm, rb)))
    result.unclear = result.unclear & ~result.mask
    return result


def _put(result: ShortEvents, lanes: Tensor, low: Tensor, high: Tensor, g_low: Tensor, g_high: Tensor) -> None:
    """Note what encloses the event of some lanes (a mask)."""
    result.mask = result.mask | lanes
    result.low, result.high = torch.where(lanes, low, result.low), torch.where(lanes, high, result.high)
    result.g_low, result.g_high = torch.where(lanes, g_low, result.g_low), torch.where(lanes, g_high, result.g_high)
    result.size = torch.where(lanes, low + (high - low) * g_low / (g_low - g_high), result.size)


def _turn(g0: Tensor, m0: Tensor, g1: Tensor, m1: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
    """Where in 0 < s < 1 the cubic turns after it has gone the way (1 or -1), and its value there; nan: nowhere."""
    a, b = 6.0 * (g0 - g1) + 3.0 * (m0 + m1), -6.0 * (g0 - g1) - 4.0 * m0 - 2.0 * m1  # p' = a s^2 + b s + m0
    root = torch.sqrt(b * b - 4.0 * a * m0)
    # The turn after which the slope has the sign -way: p'' = 2 a s + b = -way root. Both forms: neither cancels.
    s = torch.where(way * b > 0.0, -(b + way * root) / (2.0 * a), 2.0 * m0 / (way * root - b))
    s = torch.where((s > 0.0) & (s < 1.0), s, torch.nan)
    p = g0 + s * (m0 + s * (0.5 * b + s * a / 3.0))
    return s, p
