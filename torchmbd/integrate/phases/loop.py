"""The loop through the phases of a simulation: regular steps of all lanes, steps of other sizes at switches.

    h* : g(t + h*, x(h*)) = 0       the last step of a phase, by Newton's method on its size      dh*/db = -g_b / g_h
    t_k - t*                        the first step of the next one, back to the grid

An integrator makes regular steps by its stepper, and those of other sizes by `Integrator.step_of_size`. The steps
are differentiated as they stand: sizes are numbers with design tangents, and h*, while it is iterated, is one more.
What the adjoint needs is recorded (`PhaseRecord`). Steps that are too short for the integrator are not made: the last step of
a phase begins one point of the grid earlier instead, the first one ends one later, and the points between take the first
terms of the Taylor series from the switch.

All lanes are stepped together through one phase; the numbers of those that left it, or have not entered it yet, are not used.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.lanes import lanes_of, pick_lanes
from torchmbd.integrate.phases.run import MultiphaseRun, PhaseExit, PhaseRecord
from torchmbd.integrate.variable_step import narrowed, shortly_after, widened, widened_data
from torchmbd.math.pair import Pair, value
from torchmbd.results.state import State

_SAME = 1e-9  # of a regular step: times that are equal
_ROUND = 1e-13  # of the size
_MOST = 40  # iterations for the size of a last step


def integrate(multiphase: MultiphaseRun, integrator: Integrator) -> dict[str, Tensor]:
    """Integrate all lanes through all phases; errors as of Stepper.errors, the largest of all phases."""
    phase_exit, errors = multiphase.start(), {}
    for number in range(len(multiphase.phase_models)):
        phase_exit, of_phase = _PhaseLoop(multiphase, number, phase_exit, integrator).run()
        for name, x in of_phase.items():
            errors[name] = (torch.minimum if name == "valid_times" else torch.maximum)(errors.get(name, x), x)
    return errors


class _PhaseLoop:
    """All lanes in one phase, from `entry` to where they leave it."""

    def __init__(self, multiphase: MultiphaseRun, number: int, entry: PhaseExit, integrator: Integrator):
        self.multiphase, self.number, self.integrator = multiphase, number, integrator
        self.phase_model = multiphase.phase_models[number]
        self.h, self.times = multiphase.duration / multiphase.steps, multiphase.times
        self.short = max(integrator.shortest_step, _SAME)
        self.dynamics, x = multiphase.enter(number, entry)
        self.ends = multiphase.end_times(self.phase_model, entry.t)
        self.entry, self.alive = PhaseExit(entry.t, x), multiphase.entered_lanes(entry)
        self.lanes = len(self.alive)
        self.first = torch.tensor([self._first(lane) for lane in range(self.lanes)])
        self.event = self.phase_model.phase.until if isinstance(self.phase_model.phase.until, Event) else None
        self.g = self._start_values()
        self.record = PhaseRecord(number, self.dynamics, entry, x, self.first)
        multiphase.records.append(self.record)

    def run(self) -> tuple[PhaseExit, dict[str, Tensor]]:
        """Step until every lane has left the phase, or to the end; exits, and errors as of Stepper.errors."""
        d, x = self.dynamics, self.entry.x
        stepper = self.integrator.stepper(d, self.h)
        self._record_shortly_after()
        schedule = d.topology.schedule(self.times, d.data)
        alive, inside = self.alive, torch.zeros_like(self.alive)
        older, recent, indices = x, x, []
        for i in range(int(self.first.min()), len(self.times)):
            if bool(inside.any()):
                older, recent, x = recent, x, stepper.step(i, x, schedule[i], inside)
                indices.append(i)
            for lane in torch.nonzero(alive & (self.first == i))[:, 0].tolist():
                x = _with_lane(x, lane, self._arrival(lane))
                stepper.restart()
                inside[lane] = True
            passed, g = self._passed(i, x, inside)
            self.multiphase.record(self.phase_model, i, inside & ~(passed & self._beyond(i)), x)
            for lane in torch.nonzero(passed)[:, 0].tolist():
                self.record.exit[lane] = self._leave(lane, i, (recent, older), g)
            self.g = torch.where(inside, g, self.g)
            inside, alive = inside & ~passed, alive & ~passed
            if not bool(alive.any()):
                break
        errors = stepper.errors(self.multiphase.recorded(), self.multiphase.duration, indices) if indices else {}
        for lane, reason in stepper.failed.items():
            self.multiphase.fail(lane, reason)
        staying = torch.nonzero(alive)[:, 0].tolist()
        return self.multiphase.phase_exit(self.phase_model, self.entry, self.record.exit, staying), errors

    def _first(self, lane: int) -> int:
        """The first point of the grid that a lane steps to."""
        t = float(value(self.entry.t)[0, lane])
        if not self.alive[lane]:
            return len(self.times)
        k = math.ceil(t / self.h - _SAME)
        if self._on_grid(lane, k):
            return k
        return k + (k * self.h - t < self.short * self.h)

    def _on_grid(self, lane: int, k: int) -> bool:
        """Whether a lane enters at a point of the grid, whatever the design."""
        t = float(value(self.entry.t)[0, lane])
        return not self.multiphase.begin_depends[self.number] and abs(t - k * self.h) < _SAME * self.h

    def _arrival(self, lane: int) -> State:
        """The state of a lane at its first point of the grid."""
        k, (t, x) = int(self.first[lane]), self.entry.lane(lane)
        self.record.on_grid[lane] = self._on_grid(lane, k)
        if not self.record.on_grid[lane]:
            end = t * 0.0 + float(self.times[k])
            x = self.integrator.step_of_size(lanes_of(self.dynamics, [lane]), x, end - t, end)
        self.record.arrival[lane] = x
        return x

    def _record_shortly_after(self) -> None:
        """Record the points of the grid that lie between a switch and the first that a lane steps to."""
        t = value(self.entry.t)[0]
        for k in range(len(self.times)):
            between = self.alive & (t <= self.times[k] + _SAME * self.h) & (k < self.first)
            if bool(between.any()):
                h = self._time(k) - self.entry.t
                self.multiphase.record(
                    self.phase_model, k, between, shortly_after(self.dynamics.topology, self.entry.x, h)
                )

    def _start_values(self) -> Tensor:
        """The event's function [lanes] where the lanes enter."""
        g = torch.zeros(self.lanes, dtype=torch.float64)
        if self.event is not None:
            for lane in torch.nonzero(self.alive)[:, 0].tolist():
                g[lane] = self.multiphase.views.value(
                    self.event, [lane], lanes_of(self.dynamics, [lane]), *self.entry.lane(lane)
                )[0]
        return g

    def _passed(self, i: int, x: State, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Which lanes leave the phase before, or little after, a point of the grid; and the event's function there."""
        if self.event is not None:
            g = self.multiphase.views.values(self.event, self.dynamics, self.times[i], x)
            return inside & self.event.passed(self.g, g), g
        if self.ends is None:
            return torch.zeros_like(inside), self.g
        return inside & (self.times[i] > value(self.ends)[0] - self.short * self.h), self.g

    def _beyond(self, i: int) -> Tensor:
        """Which of the leaving lanes had left before a point of the grid."""
        if self.ends is None:
            return torch.ones_like(self.alive)
        return self.times[i] > value(self.ends)[0] - _SAME * self.h

    def _leave(self, lane: int, i: int, states: tuple[State, State], g: Tensor) -> PhaseExit:
        """Where a lane leaves between the point i of the grid and the one before, or its entry."""
        points = [i - 1 - k for k in range(min(2, i - int(self.first[lane])))]
        share = float(self.g[lane] / (self.g[lane] - g[lane]))
        skipped = self.event is not None and share < self.integrator.shortest_step and bool(points)
        k = [*points, None][int(skipped)]
        before = self.entry if k is None else PhaseExit(self._time(k), states[int(skipped)])
        t, x = before.lane(lane)
        self.record.base[lane] = k, x
        if self.event is None:
            end = pick_lanes(self.ends, [lane])
            return PhaseExit(end, self.integrator.step_of_size(lanes_of(self.dynamics, [lane]), x, end - t, end))
        return self._located(self.event, lane, PhaseExit(t, x), float(self.times[i] - value(t)[0, 0]), share)

    def _time(self, i: int) -> Any:
        """A time of the grid, which no design moves."""
        return self.entry.t * 0.0 + float(self.times[i])

    def _located(self, event: Event, lane: int, base: PhaseExit, most: float, share: float) -> PhaseExit:
        """Where the event's function of a lane vanishes, within the time `most` after a point."""
        wide = widened_data(lanes_of(self.dynamics, [lane]))
        x, t = base.x.map(widened), widened(base.t)
        one = widened(torch.zeros(1, 1, dtype=torch.float64), t.shape[0] - 1)
        one.full[-1] = 1.0
        low, high = 0.0, most
        h = most - (1.0 - share) * min(self.h, most)
        sign = math.copysign(1.0, float(self.g[lane]))
        for _ in range(_MOST):
            size = one + h
            y = self.integrator.step_of_size(wide, x, size, t + size)
            g, slope = self.multiphase.views.slopes(event, [lane], wide, t + size, y)
            low, high = (h, high) if float(g) * sign > 0.0 else (low, h)
            better = h - float(g / slope[-1])
            if abs(better - h) <= _ROUND * most:
                break
            h = better if low < better < high else 0.5 * (low + high)
        rate = -slope[:-1] / slope[-1]
        return PhaseExit(narrowed(t + size, rate), y.map(lambda z: narrowed(z, rate)))


def _with_lane(x: State, lane: int, new: State) -> State:
    """The state of all lanes with one lane replaced."""

    def put(y: Any, z: Any) -> Any:
        full = (y.full if isinstance(y, Pair) else y).clone()
        full[..., lane] = (z.full if isinstance(z, Pair) else z)[..., 0]
        return Pair(full) if isinstance(y, Pair) else full

    return State(*(put(y, z) for y, z in zip(x, new, strict=True)))
