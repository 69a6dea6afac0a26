"""The loop that makes every motion, phase by phase: regular steps of all lanes, steps of other sizes at switches.

    h* : g(t + h*, x(h*)) = 0       the last step of a phase (last_steps.py)
    t_k - t*                        the first step of the next one, back to the grid

All steps are those of the condensed system of the segment: regular ones by the stepper of the integrator, many at a time
(regular_steps.py), those of other sizes by `Integrator.step_of_size`. After a switch, and where the size changes, steps begin
from the states of `Integrator.smooth_start`; regular steps that end at a switch that changes nothing go on as they were. The
size of a step is a number with design tangents, so each step is differentiated as it is. `PhaseRecord` keeps what the adjoint
needs.
Steps that are too short for the integrator are not made: the last step of a phase begins one point of the grid earlier instead,
the first one ends one later, and the points between take the first terms of the Taylor series from the switch, accelerations
and multipliers on the way to those of the first step.

All lanes are stepped together through one phase; the numbers of those that left it, or have not entered it yet, are not used.
A motion without switches is a single phase, which all lanes enter at the start and none leaves.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.estimates import StepEstimates
from torchmbd.integrate.integrator import Stepper
from torchmbd.integrate.lanes import (
    lane_numbers,
    lanes_of,
    pick_lanes,
    pick_states,
    put_lanes,
    put_states,
)
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.last_steps import Bracket, finite_lanes, located, without_rate
from torchmbd.integrate.phases.phase_record import PhaseExit, PhaseRecord
from torchmbd.integrate.phases.regular_steps import RegularSteps
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.phases.short_events import ShortEvents, ShortEventSearch, near_zero
from torchmbd.integrate.smooth_start import SmoothStart
from torchmbd.integrate.statistics import TURN, Statistics
from torchmbd.integrate.variable_step import MovingSteps, on_the_way, shortly_after
from torchmbd.math.elementwise import reciprocal
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.saddle.condensation import Condensation
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.progress import announce
from torchmbd.results.history import History, longest_run
from torchmbd.results.state import State

# Steps that are made at once where an event may end the phase: as many as were made so far, within these bounds. Those after
# the event are lost, but an evaluation of the event's function takes as long as some hundred steps of one design.
_BETWEEN_EVENTS = 50, 400
_SAME = 1e-9  # of a regular step: times that are equal


def integrate(multiphase: MultiphaseRun) -> Statistics:
    """Integrate all lanes through all phases, into the record of the run; return the statistics of their steps.

    Those of steppers are the largest of all phases. Alternations are measured in the second half of each phase.
    """
    announce(multiphase.steps, multiphase.whole.lanes)
    evaluations = multiphase.whole.statistics["evaluations"]
    estimates = multiphase.integrator.estimates(multiphase.recorded, multiphase.duration, multiphase.steps)
    phase_exit, largest = multiphase.start(), Statistics()
    for number in range(len(multiphase.segments)):
        phase_exit, of_phase = _PhaseLoop(multiphase, number, phase_exit, estimates).run()
        largest = largest.maximum(of_phase)
    multiphase.states.put_rates(0, multiphase.initial_rates)
    if estimates is None:
        return replace(largest, evaluations=multiphase.whole.statistics["evaluations"] - evaluations)
    estimates.put_into(largest, multiphase.phase_number, multiphase.every)
    return largest


class _PhaseLoop:
    """All lanes in one phase, from `entry` to where they leave it."""

    def __init__(self, multiphase: MultiphaseRun, number: int, entry: PhaseExit, estimates: StepEstimates | None):
        self.multiphase, self.number, self.estimates = multiphase, number, estimates
        self.integrator, self.segment = multiphase.integrator, multiphase.segments[number]
        self.h, self.times = multiphase.duration / multiphase.steps, multiphase.times
        self.short = max(self.integrator.shortest_step, _SAME)
        prepared = multiphase.enter(number, entry)
        self.dynamics, self.condensed, x = prepared.whole, prepared.condensed, prepared.state
        self.ends = multiphase.end_times(self.segment, entry.t, self.dynamics.data)
        self.entry, self.alive = PhaseExit(entry.t, x), multiphase.entered_lanes(entry)
        self.lanes = len(self.alive)
        self.first = torch.tensor([self._first(lane) for lane in range(self.lanes)])
        self.event = self.segment.phase.until if isinstance(self.segment.phase.until, Event) else None
        self.is_of_instants = False  # not known yet whether the event's function is
        on_grid = torch.tensor([self._on_grid(lane, int(k)) for lane, k in enumerate(self.first)])
        goes_on = torch.zeros_like(self.alive)
        if number and bool((before := multiphase.records[-1].ends_on_grid).any()):
            goes_on = before & multiphase.goes_on(number, self.dynamics, entry)
        self.record = PhaseRecord(
            number, self.dynamics, self.condensed, entry, x, prepared.start, self.first, on_grid, goes_on
        )
        if prepared.begin is not None:
            self.record.arrival = prepared.begin
        self.search = None
        if self.event is not None:
            self.search = ShortEventSearch(self.event, self.record, self.integrator, multiphase.views, self.times)
        self.g = self.g_first = self._start_values()  # the event's function; at the first points of the grid
        self.first_events: ShortEvents | None = None  # in the steps to these
        self.first_counts = torch.ones_like(self.alive)  # lanes whose function is more than rounding in these steps
        self.base_time = entry.t  # of lanes that leave, where their last step begins
        self.bracket = Bracket(*torch.zeros(4, self.lanes, dtype=torch.float64))  # of the sizes of their last steps
        self.change = torch.full_like(self.g, torch.inf)  # of the event's function in the step before
        multiphase.records.append(self.record)

    def run(self) -> tuple[PhaseExit, Statistics]:
        """Step until every lane has left the phase, or to the end; exits, and statistics as in Stepper."""
        record, x, last = self.record, self.record.base, len(self.times) - 1
        i, steps, every = int(self.first.min()), None, self.multiphase.every
        stepper: Stepper = (
            MovingSteps(self.integrator, self.condensed, self._time)
            if self.multiphase.duration_moves
            else self.integrator.stepper(self.condensed, self.h)
        )
        self._arrive()
        self._record_shortly_after()
        inside = torch.zeros_like(self.alive)
        while i <= last:
            arriving = lane_numbers(self.alive & (self.first == i))
            if arriving:
                x = put_states(x, arriving, pick_states(record.arrival, arriving))
                stepper.restart(self.alive & (self.first == i))
                record.restarts.append(i)
                inside |= self._arrived(i, arriving, x)
            if i == last or not bool(self.alive.any()):
                break
            j = self._boundary(i, last)
            if bool(inside.any()):
                if every > 1 and i % every == 0:
                    record.checkpoints[i] = value(x.a).clone()
                    stepper.restart()
                into = self.multiphase.states if self._keeps_all(inside) else None
                steps = RegularSteps(stepper, self.condensed, self.times, i, j, x, inside, steps, into)
                x = steps.end
                inside = self._left_behind(steps, inside)
            i = j
        for lane, reason in stepper.failed.items():
            if not bool(record.has_exit[lane]):  # else it failed in steps after its event, which are lost
                self.multiphase.fail(lane, reason)
        if bool(self.alive.any()):
            self.multiphase.end(self.segment, lane_numbers(self.alive))
        if bool(record.has_exit.any()):
            self._leave(lane_numbers(record.has_exit))
        return record.exit, stepper.statistics()

    def _keeps_all(self, inside: Tensor) -> bool:
        """True if the steps of lanes `inside` are the record of the motion as they are."""
        multiphase, all_stay = self.multiphase, self.event is None and self.ends is None and bool(inside.all())
        return all_stay and self.condensed is multiphase.recorded and multiphase.every == 1

    def _boundary(self, i: int, last: int) -> int:
        """The point at which the steps from the point i are interrupted: where lanes arrive or the last one leaves, for events,
        at checkpoints."""
        stops, every = [last, *(k for k in self.first.tolist() if i < k)], self.multiphase.every
        if self.ends is not None:
            stops.append(max(i + 1, int((~self._past_end(torch.arange(len(self.times))))[:, self.alive].any(1).sum())))
        most = longest_run(every)
        if self.event is not None:
            fewest, largest = _BETWEEN_EVENTS
            most = min(most, every * max(min(max(fewest, i - int(self.first.min())), largest) // every, 1))
        if every == 1:
            return min([i + most, *stops])
        return min([i + most - i % most, *stops])

    def _arrived(self, i: int, lanes: list[int], x: State) -> Tensor:
        """Record lanes at their first point i of the grid, where all have the condensed states x; which stay in the phase."""
        new = torch.zeros_like(self.alive)
        new[lanes] = True
        g, short = torch.where(new, self.g_first, self.g), self.first_events
        passed = new & self._passed(torch.tensor([i]), torch.stack([self.g, g], 1))[0] & self.first_counts
        if short is not None:
            passed = passed | self._occurred(short, new & ~passed, value(self.entry.t)[0])
        counted = (new & ~(passed & self._beyond(i)))[None]
        self._record(i, History.of([x]), counted, counted)
        if bool(passed.any()):
            self._note_bases(lane_numbers(passed), i, (x, x), g, short)
        self.g, self.alive = g, self.alive & ~passed
        return new & ~passed

    def _left_behind(self, steps: RegularSteps, inside: Tensor) -> Tensor:
        """Record steps of the lanes `inside`, and let those leave that pass the end of the phase; which stay."""
        i, history = steps.first, steps.states
        if self.event is None and self.ends is None:  # none leaves
            counted = inside.repeat(len(history.q), 1)
            errors = steps.stepper.take_errors(counted[1:])
            self._record(i, history, counted, counted, errors, self._keeps_all(inside))
            return inside
        g = self.g[:, None].expand(-1, len(history.q))
        if self.event is not None:
            g = torch.cat([self.g[:, None], self._event_values(i + 1, history.at(slice(1, None)))], 1)
        change = torch.cat([self.change[:, None], (g[:, 1:] - g[:, :-1]).abs()], 1)
        counted = torch.zeros(len(history.q), self.lanes, dtype=torch.bool)
        stepped = counted.clone()
        of_points, short_events = self._passed(torch.arange(i + 1, i + len(history.q)), g) & inside, {}
        if self.search is not None:
            passed = self.search.counted(steps, of_points.T, g)
            short_events = self.search.in_regular_steps(steps, inside, g, change, passed)
            of_points = passed.T
        counted[1:] = stepped[1:] = inside
        for k in sorted({k + 1 for k in lane_numbers(of_points.any(1))}.union(short_events)):
            p, self.g = i + k, g[:, k - 1]
            passed, short = inside & of_points[k - 1], short_events.get(k)
            if short is not None:
                passed = passed | self._occurred(short, inside & ~passed, self.times[p - 1].expand(self.lanes))
            leaving = lane_numbers(passed)
            if not leaving:
                continue
            self._note_bases(leaving, p, (steps.state(p - 1), steps.state(p - 2)), g[:, k], short)
            counted[k] = inside & ~(passed & self._beyond(p))
            inside, self.alive = inside & ~passed, self.alive & ~passed
            counted[k + 1 :] = stepped[k + 1 :] = inside
        stepped[0] = stepped[1]
        self._record(i, history, counted, stepped, steps.stepper.take_errors(stepped[1:]))
        self.g, self.change = g[:, -1], change[:, -1]
        return inside

    def _event_values(self, first: int, states: History) -> Tensor:
        """The event's function [lanes, points] of condensed states at the point `first` of the grid and those after it."""
        assert self.event is not None
        times = self.times[first : first + len(states.q)]
        if not self.is_of_instants and len(times) > 1:
            self._require_instants(times, states)
        return self._function_values(times, states)

    def _require_instants(self, times: Tensor, states: History) -> None:
        """InputError if the event's function of the first or second of these states depends on the other one."""
        assert self.event is not None
        # Angles of a lane that diverges may count other full turns between two states than in one of them.
        turns = self.condensed.topology.rate_kinds == 0
        spin = torch.where(turns[:, None], states.v[:2, :, 0].abs(), 0.0).amax((0, 1))
        sound = float(times[1] - times[0]) * spin <= TURN
        g, of_first, of_second = (
            self._function_values(times[k], History(states.q[k], states.v[k], states.vd[k], states.lam[k]))
            for k in (torch.tensor(pair) for pair in ([0, 1], [0, 0], [1, 1]))
        )
        alone = torch.stack([of_first[:, 0], of_second[:, 1]], 1)
        self.event.require_instants(g[sound], alone[sound])
        self.is_of_instants = bool((states.q[0] != states.q[1])[..., sound].any())  # else both are one state

    def _function_values(self, times: Tensor, states: History) -> Tensor:
        """The event's function [lanes, points] of condensed states at these times."""
        assert self.event is not None
        dynamics = self.dynamics.values()
        q, v, vd, lam = (x[:, :, :1] for x in states.states)
        history = History(q, v, vd, lam, times=times)
        if self.record.condensation is not None:
            history = replace(history, expansion=Expansion.of(self.record.condensation, dynamics.data, times))
        return self.multiphase.views.along(self.event, dynamics, times, history)

    def _record(
        self,
        first: int,
        states: History,
        counted: Tensor,
        stepped: Tensor,
        errors: Tensor | None = None,
        are_kept: bool = False,
    ) -> None:
        """Record condensed states at the point `first` of the grid and those after it, of lanes that count [points, lanes].

        stepped   lanes that have these states;  errors: of the iterations of the steps between them
        """
        multiphase = self.multiphase
        recorded = states if self.condensed is multiphase.recorded else self._of_whole(first, states)
        multiphase.record(self.number, first, counted, recorded, are_kept)
        if self.estimates is not None and errors is not None:
            c, every_lane = self.record.condensation, bool(stepped.all())
            unknowns = states if self.condensed is multiphase.recorded or c is None else self._unknowns(c, states)
            self.estimates.update(first, unknowns, errors, None if every_lane else stepped)

    def _of_whole(self, first: int, states: History) -> History:
        """States of the whole system, out of those of the steps; multipliers of other rows are zero."""
        c, times, rows = self.record.condensation, self.times[first : first + len(states.q)], self.segment.rows
        q, v, vd, lam = states.states
        if c is not None and self.multiphase.duration_moves:  # bodies of known motion move with the times of the grid
            points = [State(*(Pair(x[k]) for x in (q, v, vd, vd, lam))) for k in range(len(times))]
            points = [self.record.whole(x, self._time(first + k)) for k, x in enumerate(points)]
            q, v, vd = History.of(points).states[:3]
        elif c is not None:
            expansion = Expansion.of(c, self.dynamics.data, times)
            q, v, vd = (expansion.rows(order, x) for order, x in enumerate((q, v, vd)))
        if c is not None:
            rows = [rows[k] for k in c.rows.tolist()]
        all_rows = lam.new_zeros(len(lam), self.multiphase.whole.topology.rows, *lam.shape[2:])
        return History(q, v, vd, all_rows.index_copy(1, torch.tensor(rows, dtype=torch.long), lam))

    def _unknowns(self, c: Condensation, states: History) -> History:
        """Condensed states as those of the whole system, zero where a body is not an unknown: its motion has no error."""
        T, (q, v, vd, lam) = self.dynamics.topology, states.states

        def whole(x: Tensor, rows: Tensor, count: int) -> Tensor:
            return x.new_zeros(len(x), count, 1, x.shape[-1]).index_copy(1, rows, x[:, :, :1])

        return History(
            whole(q, c.coordinates, T.n_q), whole(v, c.independent, T.n_v), whole(vd, c.independent, T.n_v), lam
        )

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
        """True if a lane enters at a point of the grid, whatever the design."""
        t = float(value(self.entry.t)[0, lane])
        return not self.multiphase.begin_depends[self.number] and abs(t - k * self.h) < _SAME * self.h

    def _arrive(self) -> None:
        """Find the states of lanes at their first point of the grid, and events in the steps to it."""
        record, arriving = self.record, self.alive & (self.first < len(self.times))
        going_on = lane_numbers(arriving & record.goes_on)
        if going_on:
            before = record.retained(pick_states(record.entry.x, going_on))
            record.arrival = put_states(record.arrival, going_on, before)
        entering = arriving & ~record.goes_on
        begun = lane_numbers(entering if self.number else entering & ~record.on_grid)
        if not begun:
            return
        start, regular = PhaseExit(self.entry.t, record.start_of_steps).lanes(begun), self._regular_size(begun)
        smooth = self._smooth_start(begun, start)
        record.arrival = put_states(record.arrival, begun, smooth.resized(start.x, regular))
        lanes = lane_numbers(arriving & ~record.on_grid)
        if not lanes:
            return
        some = [begun.index(lane) for lane in lanes]
        entry, smooth, regular = start.lanes(some), smooth.lanes(some), pick_lanes(regular, some)
        end = self.multiphase.grid_times(self.first[lanes], entry.t)
        size = end - entry.t
        x = self.integrator.step_of_size(lanes_of(self.condensed, lanes), smooth.resized(entry.x, size), size, end)
        x = smooth.resized(x, regular, size)
        self.record.arrival = put_states(self.record.arrival, lanes, x)
        self._fail(~finite_lanes(x), lanes, "first", entry, value(end)[0])
        self.alive[lanes] = self.alive[lanes] & finite_lanes(x)
        if self.event is None or self.search is None:
            return
        t, t1, at_start, at_end = value(entry.t), value(end), entry.x.values(), x.values()
        dynamics = lanes_of(self.dynamics, lanes)
        before = self.g[lanes]
        after = self.multiphase.views.value(self.event, lanes, dynamics, t1, self.record.whole(at_end, t1))
        self.g_first = self.g.index_copy(0, torch.tensor(lanes), after)
        ends = self.record.whole(at_start, t), self.record.whole(at_end, t1)
        counted = self.search.rounding.exceeded(lanes, (t, t1), ends, torch.stack([before, after]))
        self.first_counts[lanes] = counted
        passed = self.event.passed(before, after)
        near = lane_numbers(near_zero(before, after, self.change[lanes]) & ~passed & counted)
        if near:
            some, begin, size = [lanes[i] for i in near], pick_lanes(t, near), pick_lanes(t1 - t, near)
            ends = pick_states(at_start, near), pick_states(at_end, near)
            events = self.search.in_steps(some, begin, size, ends, (before[near], after[near]))
            self.first_events = events.in_lanes(some, self.lanes)

    def _regular_size(self, lanes: list[int]) -> Any:
        """Size of regular steps of some lanes [1 + n, lanes]."""
        return self.multiphase.grid_times(torch.tensor(1), pick_lanes(self.entry.t, lanes))

    def _size_before(self, lanes: list[int]) -> Any:
        """Size of the steps before the last ones [1 + n, lanes]; zero where these begin at the switch."""
        return self._regular_size(lanes) * (self.record.base_point[lanes] >= 0).double()

    def _smooth_start(self, lanes: list[int], start: PhaseExit) -> SmoothStart:
        """Return the smooth start of some lanes, for condensed states."""
        of_lanes = lanes_of(self.dynamics, lanes), start.x, start.t, self._regular_size(lanes)
        return self.record.smooth_start(self.integrator, *of_lanes)

    def _fail(self, failed: Tensor, lanes: list[int], which: str, start: PhaseExit, end: Tensor) -> None:
        """Note that the first or the last step of a phase, from `start` to times `end`, does not converge in some lanes."""
        for i in lane_numbers(failed):
            begin, step = float(value(start.t)[0, i]), f"the {which} step of phase {self.segment.name!r}"
            reason = f"{step}, from t = {begin:.6g} s to t = {float(end[i]):.6g} s, does not converge. Try: more steps"
            if not bool(finite_lanes(start.x)[i]):
                reason = f"the motion is not finite where {step} begins, at t = {begin:.6g} s"
            self.multiphase.fail(lanes[i], reason)

    def _record_shortly_after(self) -> None:
        """Record the points of the grid that lie between a switch and the first that a lane steps to."""
        t = value(self.entry.t)[0]
        between = self.alive & (t <= self.times[:, None] + _SAME * self.h)
        between &= torch.arange(len(self.times))[:, None] < self.first  # [times, lanes]
        for k in lane_numbers(between.any(1)):
            h = self._time(k) - self.entry.t
            x = self.record.retained(shortly_after(self.dynamics.topology, self.entry.x, h))
            lanes = lane_numbers(between[k] & (self.first < len(self.times)))
            if lanes:
                h, t = pick_lanes(h, lanes), pick_lanes(self.entry.t, lanes)
                share = h * reciprocal(self.multiphase.grid_times(self.first[lanes], t) - t)
                ends = pick_states(x, lanes), pick_states(self.record.arrival, lanes)
                x = put_states(x, lanes, on_the_way(*ends, share))
            self._record(k, History.of([x]), between[k][None], between[k][None])

    def _start_values(self) -> Tensor:
        """The event's function [lanes] where the lanes enter."""
        g, lanes = torch.zeros(self.lanes, dtype=torch.float64), lane_numbers(self.alive)
        if self.event is not None and lanes:
            entry = self.entry.lanes(lanes)
            g[lanes] = self.multiphase.views.value(self.event, lanes, lanes_of(self.dynamics, lanes), *entry)
        return g

    def _passed(self, points: Tensor, g: Tensor) -> Tensor:
        """Where lanes leave the phase before, or little after, points of the grid [points, lanes].

        g   the event's function at these and at the point before [lanes, points + 1]
        """
        return self._past_end(points) if self.event is None else self.event.passed(g[:, :-1], g[:, 1:]).T

    def _past_end(self, points: Tensor) -> Tensor:
        """True if points of the grid are after, or little before, the end of a phase at a known time [points, lanes]."""
        t = self.times[points, None]
        if self.ends is None:
            return torch.zeros(len(t), self.lanes, dtype=torch.bool)
        return t > value(self.ends)[0] - self.short * self.h

    def _ends_at(self, i: int) -> Tensor:
        """True if the phase of lanes ends at a point of the grid, whatever the design [lanes]."""
        if self.ends is None or self.multiphase.end_depends(self.number):
            return torch.zeros_like(self.alive)
        return (self.times[i] - value(self.ends)[0]).abs() < _SAME * self.h

    def _beyond(self, i: int) -> Tensor:
        """Which of the leaving lanes had left before a point of the grid."""
        if self.ends is None:
            return torch.ones_like(self.alive)
        return self.times[i] > value(self.ends)[0] - _SAME * self.h

    def _occurred(self, short: ShortEvents, lanes: Tensor, t: Tensor) -> Tensor:
        """Which of some lanes (a mask) pass an event in a step from t [lanes]; those of which this is not clear are noted."""
        for lane in lane_numbers(short.unclear & lanes):
            self.multiphase.doubt(lane, self.segment, float(t[lane]))
        return short.mask & lanes

    def _note_bases(
        self, lanes: list[int], i: int, states: tuple[State, State], g: Tensor, short: ShortEvents | None
    ) -> None:
        """Note where the last steps begin of lanes that leave between the point i of the grid and the one before, or their
        entry; and, where an event ends the phase, what encloses their sizes.

        states   at the two points before
        """
        record, inner = self.record, (i - self.first[lanes]).clamp(0, 2)  # points in the phase, as far as they matter
        begin = torch.where(inner > 0, self.times[i - 1], value(self.entry.t)[0, lanes])
        high, g_low, g_high = self.times[i] - begin, self.g[lanes], g[lanes]
        low, size = torch.zeros_like(high), high * g_low / (g_low - g_high)
        if short is not None:
            of_short = short.low, short.high, short.size, short.g_low, short.g_high
            pairs = zip(of_short, (low, high, size, g_low, g_high), strict=True)
            low, high, size, g_low, g_high = (torch.where(short.mask[lanes], x[lanes], y) for x, y in pairs)
        # Steps that are too short for the integrator begin one point earlier.
        skipped = (inner > 0) & (size < self.integrator.shortest_step * self.h) & (self.event is not None)
        points = torch.where(skipped < inner, i - 1 - skipped.long(), -1)
        for k in map(int, set(points.tolist())):
            some = [lane for lane, point in zip(lanes, points.tolist(), strict=True) if point == k]
            t, x = self._time(k) if k >= 0 else self.entry.t, states[i - 1 - k] if k >= 0 else record.start_of_steps
            t, x = pick_lanes(t, some), pick_states(x, some)
            record.base, self.base_time = put_states(record.base, some, x), put_lanes(self.base_time, some, t)
        record.has_exit[lanes], record.base_point[lanes] = True, points
        record.ends_on_grid[lanes] = (points == i - 1) & self._ends_at(i)[lanes]
        earlier = begin - value(self.base_time)[0, lanes]
        for total, x in zip(self.bracket, (low + earlier, high + earlier, g_low, g_high), strict=True):
            total[lanes] = x

    def _leave(self, lanes: list[int]) -> None:
        """Make the last steps of the lanes that left the phase."""
        record, bracket = self.record, Bracket(*(x[lanes] for x in self.bracket))
        base = PhaseExit(pick_lanes(self.base_time, lanes), pick_states(record.base, lanes))
        if self.event is None:
            end, x = pick_lanes(self.ends, lanes), base.x
            others = lane_numbers(~record.ends_on_grid[lanes])
            if others:
                start, some = base.lanes(others), [lanes[i] for i in others]
                sizes = pick_lanes(end - base.t, others), self._size_before(some)
                x = put_states(x, others, self._smooth_start(some, start).resized(start.x, *sizes))
            y = self.integrator.step_of_size(lanes_of(self.condensed, lanes), x, end - base.t, end)
            there, success = PhaseExit(end, record.whole(y, end)), finite_lanes(y)
        else:
            sizes = self._regular_size(lanes), self._size_before(lanes)
            of_lanes = lanes, base, bracket, record, self.integrator, self.multiphase.views
            there, success = located(self.event, *of_lanes, *sizes)
        self._fail(~success, lanes, "last", base, value(base.t)[0] + bracket.high)
        for i in lane_numbers(success & ~torch.isfinite(value(there.t)[0])):
            self.multiphase.failed_for_good.add(lanes[i])
            self.multiphase.fail(lanes[i], str(without_rate(self.segment.name)))
        success = success & torch.isfinite(value(there.t)[0])
        good = lane_numbers(success)
        if good:
            exit_lanes, there = [lanes[i] for i in good], there.lanes(good)
            record.exit = PhaseExit(
                put_lanes(record.exit.t, exit_lanes, there.t), put_states(record.exit.x, exit_lanes, there.x)
            )

    def _time(self, i: int) -> Any:
        """A time of the grid, of all lanes."""
        return self.multiphase.grid_times(torch.tensor(i), self.entry.t)
