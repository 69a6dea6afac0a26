"""Every method of torchdiffeq through the phases of a simulation, lane by lane.

Within a phase the augmented state of ode.py, with derivatives at fixed times. At its end t*(b) they become total ones,

    dz*/db = dz/db + z' dt*/db        and after the switch again derivatives at fixed times        dz/db = dz*/db - z' dt*/db

An event is located by Newton's method on its time: z is integrated on, or back, by -g / g' until that is rounding.
Checked in tests/integrators/test_phases.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchmbd.integrators.compiled_rates import RightHandSide
from torchmbd.integrators.course import Course, Passage
from torchmbd.integrators.events import Event
from torchmbd.integrators.ode import flow
from torchmbd.integrators.phases import Stage
from torchmbd.integrators.sized import narrowed, widened, widened_data
from torchmbd.integrators.step import State
from torchmbd.integrators.switch import accelerations, at_time, lane_of, pick
from torchmbd.numerics.pair import Pair, cat, value
from torchmbd.system.dynamics import Dynamics

_SAME = 1e-9  # of an output interval: times that are equal
_ROUND = 1e-13  # of an output interval
_MOST = 30  # iterations for the time of an event


def integrate(course: Course, given: dict[str, Any]) -> dict[str, Any]:
    """Integrate all lanes through all stages; `given`: arguments of torchdiffeq.odeint. Statistics: evaluations."""
    before = course.whole.statistics["evaluations"]
    passage = course.start()
    for number in range(len(course.stages)):
        passage = _leg(course, number, passage, given)
    return {"evaluations": course.whole.statistics["evaluations"] - before}


def _leg(course: Course, number: int, entry: Passage, given: dict[str, Any]) -> Passage:
    """All lanes through one stage, one after the other."""
    dynamics, x = course.enter(number, entry)
    entry, stage = Passage(entry.t, x), course.stages[number]
    left, staying, ends = {}, [], course.end(stage, entry.t)
    for lane in torch.nonzero(course.arrived(entry))[:, 0].tolist():
        try:
            passage = _Lane(course, stage, dynamics, lane, entry, given).run(
                None if ends is None else pick(ends, [lane])
            )
        except FloatingPointError as error:
            course.fail(lane, str(error))
            continue
        if passage is None:
            staying.append(lane)
        else:
            left[lane] = passage
    return course.passage(stage, entry, left, staying)


class _Lane:
    """One lane in one stage."""

    def __init__(
        self, course: Course, stage: Stage, dynamics: Dynamics, lane: int, entry: Passage, given: dict[str, Any]
    ):
        self.course, self.stage, self.lane, self.given = course, stage, lane, given
        self.dynamics = lane_of(dynamics, lane)
        self.rates = RightHandSide(self.dynamics)
        self.entry = entry.lane(lane)
        self.mask = torch.arange(course.whole.lanes) == lane
        self.h, self.times = course.duration / course.steps, course.times

    def run(self, end: Any) -> Passage | None:
        """Through the stage to a known end [1 + n_b, 1], or its event; where the lane leaves it, None if it does not."""
        t, x = self.entry
        now = float(value(t))
        y = _full(cat([x.q, x.v]))
        if isinstance(t, Pair):
            y = y - self._rate(now, y) * t.full.index_fill(0, torch.tensor([0]), 0.0)
        until = self.course.duration if end is None else float(value(end))
        ticks = torch.nonzero((self.times > now + _SAME * self.h) & (self.times < until + _SAME * self.h))[
            :, 0
        ].tolist()
        here = torch.nonzero((self.times - now).abs() <= _SAME * self.h)[:, 0].tolist()
        if here:
            self.course.put(self.stage, here[0], self.mask, x)
        if isinstance(self.stage.phase.until, Event):
            return self._to_event(self.stage.phase.until, ticks, now, y)
        times = torch.tensor([now, *self.times[ticks].tolist()], dtype=torch.float64)
        motion = flow(self.rates, y, times, self.given) if ticks else y[None]
        for k, z in zip(ticks, motion[1:], strict=True):
            self.course.put(self.stage, k, self.mask, self._state(self._time(float(self.times[k])), z))
        if end is None or until > self.course.duration:
            return None
        return self._leave(end, self._moved(motion[-1], float(times[-1]), until))

    def _to_event(self, event: Event, ticks: list[int], now: float, y: Tensor) -> Passage | None:
        views, d = self.course.views, self.dynamics
        g = views.value(event, self.lane, d, *self.entry)
        for k in ticks:
            before, y, last, now = y, self._moved(y, now, float(self.times[k])), now, float(self.times[k])
            x, g_before = self._state(self._time(now), y), g
            g = views.value(event, self.lane, d, self._time(now), x)
            if bool(event.passed(g_before, g)):
                return self._located(event, before, last, now, float(g_before))
            self.course.put(self.stage, k, self.mask, x)
        return None

    def _located(self, event: Event, y: Tensor, now: float, last: float, g: float) -> Passage:
        """Where the event's function vanishes, between a time at which it was g and the time `last`."""
        low, high, sign = now, last, 1.0 if g > 0.0 else -1.0
        wide = widened_data(self.dynamics)
        for _ in range(_MOST):
            z = widened(_pair(y))
            z.full[:, -1:] = self._rate(now, y)
            t = widened(self._time(now))
            t.full[-1] = 1.0
            x = _state(wide, t, z)
            gap, slope = self.course.views.slopes(event, self.lane, wide, t, x)
            low, high = (now, high) if float(gap) * sign > 0.0 else (low, now)
            better = now - float(gap / slope[-1])
            if abs(better - now) <= _ROUND * self.h:
                break
            better = better if low <= better <= high else 0.5 * (low + high)
            y, now = self._moved(y, now, better), better
        rate = -slope[:-1] / slope[-1]
        return Passage(narrowed(t, rate), x.map(lambda s: narrowed(s, rate)))

    def _leave(self, end: Any, y: Tensor) -> Passage:
        """The lane at a known end, with total derivatives."""
        if isinstance(end, Pair):
            y = y + self._rate(float(value(end)), y) * end.full.index_fill(0, torch.tensor([0]), 0.0)
        return Passage(end, self._state(end, y))

    def _moved(self, y: Tensor, now: float, then: float) -> Tensor:
        if now == then:
            return y
        return flow(self.rates, y, torch.tensor([now, then], dtype=torch.float64), self.given)[-1]

    def _rate(self, t: float, y: Tensor) -> Tensor:
        """z' [n_z, 1, 1]."""
        return self.dynamics.values().rates(torch.tensor(t, dtype=torch.float64), y[:, :1])

    def _time(self, t: float) -> Any:
        """A time that no design moves."""
        return self.entry.t * 0.0 + t

    def _state(self, t: Any, y: Tensor) -> State:
        return _state(self.dynamics, t, _pair(y))


def _state(dynamics: Dynamics, t: Any, z: Any) -> State:
    """The state with accelerations and multipliers."""
    q, v = z[: dynamics.topology.n_q], z[dynamics.topology.n_q :]
    a, lam = at_time(accelerations, dynamics, t, q, v)
    return State(q, v, a, a, lam)


def _pair(y: Tensor) -> Any:
    return Pair(y) if y.shape[1] > 1 else y


def _full(x: Any) -> Tensor:
    return x.full if isinstance(x, Pair) else x
