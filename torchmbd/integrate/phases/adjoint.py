"""The adjoint of a run: from the last segment back to the first.

A segment of a lane is three maps, each the discrete one that was integrated:

    entry    (t*, state before) -> marks of locks, jump, impact, accelerations -> state after -> first point of the grid;
             (state before) -> first point of the grid, where regular steps go on
    steps    first point of the grid -> ... -> the point at which the last step begins
    exit     that point -> (t*, state at the end of a last step of another size)

The entry of the first segment is the initial state; the last segment has no exit.
Entry and exit are graphs of torch of all lanes, each at its own time, made again from what was recorded (`PhaseRecord`);
steps of other sizes are differentiable by the implicit function theorem (`step_to` of variable_step.py). One `AdjointSolver`
serves all lanes whose regular steps begin and end at the same points. If an event ends a segment, its function g vanishes at
the end of the last step, which determines the size h of this step:

    mu = -(cotangent of h) / g_h        cotangents of x and b: mu g_x', mu g_b'

Cotangents have the rows of the responses first: [rows, ...] of a number [...]. None: zero.
Cost: about a simulation for the first row and half of one for each further one, whatever the number of design variables.
Checked in tests/sensitivity/test_adjoint.py, tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.adjoint_solver import AdjointSolver, Grid, MotionCotangents
from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.lanes import lane_numbers, lanes_of, pick_lanes, pick_states, put_states
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.outputs import Outputs
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.lane_leaves import Key, LaneLeaves, add_lanes, by_lanes, pulled_back, rows_first, zeros
from torchmbd.integrate.phases.last_steps import without_rate
from torchmbd.integrate.phases.phase_record import PhaseRecord
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.phases.segment import Segment
from torchmbd.integrate.phases.switch import data_with_marks
from torchmbd.integrate.prepared import Prepared
from torchmbd.integrate.pullback import leaf
from torchmbd.integrate.smooth_start import SmoothStart
from torchmbd.integrate.step import Weights
from torchmbd.integrate.variable_step import on_the_way, shortly_after, step_to
from torchmbd.multibody.equations.data import ATTACHED, Data
from torchmbd.multibody.saddle.condensation import Condensation
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History
from torchmbd.results.state import State

MARKED = tuple(ATTACHED)  # data that locks change
_STATE = tuple(f"state {name}" for name in State._fields)  # names of leaves


@dataclass
class _Cotangents:
    """Cotangents so far: of the leaves, and of the times and states of the segment in which the adjoint is.

    lanes    that are taken back
    by       of the leaves of these lanes
    exit     of the times of the exits, and of the parts of the states there
    end      of the states at the bases of the last steps; None: no lane leaves the segment
    start    of the times of the entries, and of the states after the switch; None: as for `end`
    arrival  of the states at the first points of the grid; None: of no lane
    rates    of the initial rates, as outputs of the motion; None: zero
    """

    lanes: list[int]
    by: dict[Key, Tensor] = field(default_factory=dict)
    exit: list[Tensor] = field(default_factory=list)
    end: list[Tensor] | None = None
    start: list[Tensor] | None = None
    arrival: list[Tensor] | None = None
    rates: Tensor | None = None

    def add(self, key: Key, lanes: Sequence[int], cotangent: Tensor) -> None:
        """Add cotangents [rows, ...] of some of the lanes, counted among these."""
        of_all = len(lanes) == len(self.lanes)
        if key not in self.by:
            shape = list(cotangent.shape)
            shape[-1 if key[0] == "data" else 1] = len(self.lanes)
            self.by[key] = cotangent.clone() if of_all else cotangent.new_zeros(shape)
            if of_all:
                return
        if of_all:
            self.by[key] += cotangent
        else:
            add_lanes(self.by[key], key[0], lanes, cotangent)


class _Start(NamedTuple):
    """The initial state of lanes as a function of leaves, and the dynamics of the first segment."""

    leaves: LaneLeaves
    made: Prepared


@dataclass(eq=False)
class RunAdjoint:
    """The adjoint of some lanes of a run without design tangents. Its solvers are kept for further calls.

    names    of data by which gradients are wanted
    lanes    of the run that are taken back
    error    estimated relative error of the gradients asked for so far, of the lanes of the run [lanes]
    """

    run: MultiphaseRun
    names: Sequence[str]
    lanes: list[int]

    def __post_init__(self) -> None:
        self.integrator: OneStep = self.run.integrator
        self.weights: Weights = self.integrator.weights(self.run.duration / self.run.steps)
        self.error = torch.zeros(self.run.whole.lanes, dtype=torch.float64)
        locks = any(segment.locks for segment in self.run.segments)
        marks = [name for name in MARKED if locks and name in self.run.data_without_marks]
        self._leaf_names = [*self.names, *(name for name in marks if name not in self.names)]
        #: By the number of the segment and the lanes; of those whose states are the run's own, which take no memory.
        self.solvers: dict[tuple[int, tuple[int, ...]], AdjointSolver] = {}

    @torch.no_grad()
    def __call__(self, bar: Outputs, rows: int) -> dict[Key, Tensor]:
        """Cotangents of the lanes by data [rows, component..., 1, lanes], designs and mode shapes [rows, lanes, ...].

        bar   cotangents of states at all steps, of data with all marks, and of switches (None: zero)
        """
        so_far = _Cotangents(self.lanes)
        for name, x in bar.data.items():
            if x is not None:
                so_far.by["data", name] = rows_first(x, so_far.lanes).clone()
        if (of_rates := bar.states[1]) is not None:  # steps begin with other rates than the motion
            so_far.rates = rows_first(self._of_steps(self.run.records[0], 1, of_rates[:1])[0], so_far.lanes)
            of_rates = of_rates.index_fill(0, torch.zeros(1, dtype=torch.long), 0.0)
            bar = bar._replace(states=[bar.states[0], of_rates, *bar.states[2:]])
        for record in reversed(self.run.records):
            self._exit(record, so_far, rows)
            self._steps(record, so_far, bar.states, rows)
            if record.number:
                self._entry(record, so_far, bar, rows)
            else:
                self._initial(so_far, rows)
        return so_far.by

    def _exit(self, record: PhaseRecord, so_far: _Cotangents, rows: int) -> None:
        """From where lanes left a segment to the bases of their last steps."""
        so_far.start = so_far.end = None
        indices = lane_numbers(record.has_exit[so_far.lanes])  # counted among those of so_far
        if not indices:
            return
        entry, start = record.entry.t[:, so_far.lanes], pick_states(record.start, so_far.lanes)
        base, c = pick_states(record.base, so_far.lanes), record.condensation
        so_far.start, so_far.end = zeros(rows, [entry, *start]), zeros(rows, base)
        lanes = [so_far.lanes[i] for i in indices]
        segment = self.run.segments[record.number]
        k, there = record.base_point[lanes], record.exit.lanes(lanes)
        with torch.enable_grad():
            leaves = LaneLeaves(self.run.views, lanes, lanes_of(record.dynamics, lanes), self._leaf_names)
            dynamics = record.condensed_of(leaves.dynamics)
            t, base = leaf(entry[:, indices]), pick_states(base, indices).map(leaf)
            begin = torch.where(k < 0, t, self.run.times[k.clamp_min(0)])
            size = leaf(there.t - begin)
            event = segment.phase.until if isinstance(segment.phase.until, Event) else None
            end = begin + size if event is not None else self.run.end_times(segment, t, leaves.dynamics.data)
            of_size = size if event is not None else end - begin
            x, others = base, lane_numbers(~record.ends_on_grid[lanes])
            if others:
                start, regular = pick_states(base, others), torch.where(k < 0, 0.0, self.run.times[1])
                smooth = self._smooth_start(record, lanes_of(leaves.dynamics, others), start, pick_lanes(begin, others))
                sizes = pick_lanes(of_size, others), pick_lanes(regular, others)
                x = put_states(base, others, smooth.resized(start, *sizes))
            y = step_to(dynamics, self.integrator.weights, x, of_size, end, record.retained(there.x))
            y = record.whole(y, end)
            g = None if event is None else leaves.views.of_lanes(event, leaves.dynamics, end, y)
        keys, inputs = list(leaves.leaves), [size, t, *base, *leaves.leaves.values()]
        kinds = ["data"] * (2 + len(base)) + [kind for kind, _ in keys]  # where their lanes are
        cotangents = pulled_back([end, *y], [x[..., indices] for x in so_far.exit], inputs, rows)
        if g is not None:
            slopes = pulled_back([g], [torch.ones_like(g)[None]], inputs, 1)
            if bool((slopes[0] == 0.0).any()):
                raise without_rate(segment.name)
            mu = -cotangents[0][:, 0] / slopes[0][:, 0]  # [rows, lanes]
            cotangents = [x + by_lanes(mu, dg, kind) for x, dg, kind in zip(cotangents, slopes, kinds, strict=True)]
        _, by_t, *by_state = cotangents[: 2 + len(base)]
        so_far.start[0][..., indices] += by_t
        for key, cotangent in zip(keys, cotangents[2 + len(base) :], strict=True):
            so_far.add(key, indices, cotangent)
        for at_end, cotangent in zip(so_far.end, by_state, strict=True):
            at_end[..., indices] += torch.where(k < 0, 0.0, cotangent)
        of_start = [torch.where(k < 0, cotangent, 0.0) for cotangent in by_state]
        of_start = of_start if c is None else c.of_retained_state(of_start)
        for at_start, cotangent in zip(so_far.start[1:], of_start, strict=True):
            at_start[..., indices] += cotangent

    def _smooth_start(self, record: PhaseRecord, dynamics: Dynamics, x: State, t: Any) -> SmoothStart:
        return record.smooth_start(self.integrator, dynamics, x, t, self.run.times[1].expand_as(t))

    def _steps(self, record: PhaseRecord, so_far: _Cotangents, cotangents: MotionCotangents, rows: int) -> None:
        """From the last regular steps of all lanes to their first points of the grid."""
        so_far.arrival = None
        lanes, numbers = so_far.lanes, self.run.phase_number
        first, base = record.first[lanes], record.base_point[lanes]
        points = torch.arange(len(numbers))[:, None]
        last = torch.where(numbers[:, lanes] == record.number, points, -1).amax(0).maximum(first - 1).maximum(base)
        groups: dict[tuple[int, ...], list[int]] = {}  # lanes counted among those of so_far
        for i, of_lane in enumerate(torch.stack([first, base, last], 1).tolist()):
            if of_lane[2] >= of_lane[0]:
                groups.setdefault(tuple(of_lane), []).append(i)
        for (begin, base_point, end), group in groups.items():
            self._steps_of_group(record, range(begin, end + 1), base_point - begin, group, so_far, cotangents, rows)

    def _steps_of_group(
        self,
        record: PhaseRecord,
        points: range,
        base: int,
        group: list[int],
        so_far: _Cotangents,
        cotangents: MotionCotangents,
        rows: int,
    ) -> None:
        """As `_steps`, for lanes with the same points of the grid, and the same number `base` of steps to their base."""
        run, lanes = self.run, [so_far.lanes[i] for i in group]
        at = slice(-(-points.start // run.every), points[-1] // run.every + 1)
        in_phase = run.phase_number[at.start * run.every : points.stop : run.every]
        in_phase = pick_lanes(in_phase, lanes) == record.number
        every_point = bool(in_phase.all())
        of_states: list[Tensor | None] = [None] * len(cotangents)
        for i, x in enumerate(cotangents):
            if x is not None:
                x = self._of_steps(record, i, pick_lanes(x[at], lanes))
                of_states[i] = x if every_point else torch.where(in_phase[:, None, None], x, 0.0)
        by_start = end = None  # cotangents of the first state, and of the one at the base of the last step
        if so_far.end is not None and base >= 0:
            end = State(*(x[..., 0, group].movedim(0, -2) for x in so_far.end))
            by_start = end if base == 0 else None
        if len(points) == 1:
            if at.stop > at.start:
                q, v, vd, a, lam = by_start or record.arrival.map(lambda x: x.new_zeros(len(x), rows, len(lanes)))
                by_q, by_v, by_vd, by_lam = (0.0 if x is None else x[0] for x in of_states)
                by_start = State(q + by_q, v + by_v, vd + by_vd, a, lam + by_lam)
        else:
            if all(x is None for x in of_states):  # the rows of the others tell their number
                of_states[0] = torch.zeros(
                    at.stop - at.start, len(record.arrival.q), rows, len(lanes), dtype=torch.float64
                )
            solver = self._solver(record, points, base, group)
            of_steps, error = solver(of_states, {} if end is None or base == 0 else {base: end})
            self.error[lanes] = self.error[lanes].maximum(error)
            by_leaf = solver.grid.cotangents(of_steps)
            of_first = [by_leaf.pop(name) for name in _STATE if name in by_leaf]
            if of_first:
                by_start = State(*of_first) if end is None or base else State(*map(torch.add, of_first, end))
            for name, x in by_leaf.items():
                so_far.add(("data", name), group, x.movedim(-2, 0).unsqueeze(-2))
        if by_start is not None:
            so_far.arrival = so_far.arrival or zeros(rows, pick_states(record.arrival, so_far.lanes))
            for total, x in zip(so_far.arrival, by_start, strict=True):
                total[..., group] = x.movedim(-2, 0).unsqueeze(-2)

    def _of_steps(self, record: PhaseRecord, i: int, x: Tensor) -> Tensor:
        """Cotangents [times, n, rows, lanes] of the states of the steps, from those of the states of the run.

        i   their part: q, v, v' or lam
        """
        c, rows = self._left_out(record), self._rows_of_steps(record)
        if i == 3:
            return x if rows is None else x[:, rows]
        return x if c is None else c.of_whole(i, x)

    def _left_out(self, record: PhaseRecord) -> Condensation | None:
        """The condensation that leads from states of the run to states of the steps; None: both are the same."""
        return None if record.condensed is self.run.recorded else record.condensation

    def _rows_of_steps(self, record: PhaseRecord) -> list[int] | None:
        """Rows of the multipliers of the run that are those of the steps; None: all."""
        if record.condensed is self.run.recorded:
            return None
        rows, c = self.run.segments[record.number].rows, record.condensation
        return rows if c is None else [rows[k] for k in c.rows.tolist()]

    def _solver(self, record: PhaseRecord, points: range, base: int, group: list[int]) -> AdjointSolver:
        """Of the regular steps of lanes, counted among those that are taken back."""
        key = record.number, tuple(group)
        if key in self.solvers:
            return self.solvers[key]
        grid = self._grid(record, points, base, group)
        solver = backend_of(grid.dynamics).adjoint_solver(grid)
        if grid.history.q.untyped_storage().data_ptr() == self.run.q.untyped_storage().data_ptr():
            self.solvers[key] = solver
        return solver

    def _grid(self, record: PhaseRecord, points: range, base: int, group: list[int]) -> Grid:
        """The regular steps of lanes as in `_solver`; leaves are the data and the state at the first point."""
        run, lanes = self.run, [self.lanes[i] for i in group]
        every, c, rows = run.every, self._left_out(record), self._rows_of_steps(record)
        at = slice(-(-points.start // every), points[-1] // every + 1)
        q, v, vd, lam = (pick_lanes(x[at], lanes) for x in (run.q, run.v, run.vd, run.lam))
        if c is not None:
            q, v, vd = q[:, c.coordinates], v[:, c.independent], vd[:, c.independent]
        if not record.number and points.start == 0:
            v = torch.cat([pick_lanes(record.arrival.v, lanes)[None], v[1:]])
        history = History(q, v, vd, lam if rows is None else lam[:, rows])
        leaves, dynamics, start = self._leaves_of_steps(record, group, lanes)
        offset, cuts, starts = -points.start % every, [base] if 0 < base < len(points) - 1 else [], None
        if every > 1:
            starts = {0: pick_states(record.arrival, lanes)}
            for k, a in record.checkpoints.items():
                if points.start < k < points[-1]:
                    q, v, vd, lam = (x[(k - points.start - offset) // every] for x in history.states)
                    starts[k - points.start] = State(q, v, vd, a[..., lanes], lam)
        return Grid(
            lanes=lanes,
            history=history,
            leaves=leaves,
            dynamics=dynamics,
            start=start,
            weights=self.weights,
            times=run.times[points.start : points.stop],
            integrator=self.integrator,
            corrections=self.integrator.counts(dynamics)[1],
            every=every,
            offset=offset,
            first=points.start,
            starts=starts,
            restarts=[k - points.start for k in record.restarts if points.start < k < points[-1]],
            cuts=cuts,
        )

    def _leaves_of_steps(
        self, record: PhaseRecord, group: list[int], lanes: list[int]
    ) -> tuple[dict[str, Tensor], Dynamics, State]:
        """Leaves by name, and the dynamics and the first state of the steps of some lanes as functions of these.

        Leaves are the data and the first state. That of the first segment is a function of the data, where these are the leaves
        of the initial state as well.
        """
        if not record.number and len(group) == len(self.lanes) and not self.run.segments[0].locks:
            leaves, made = self._start
            assert made.begin is not None
            return {name: x for (kind, name), x in leaves.leaves.items() if kind == "data"}, made.condensed, made.begin
        dynamics, start = record.dynamics.select_lanes(lanes), pick_states(record.arrival, lanes).map(leaf)
        names = {name: dynamics.data[name] for name in self._leaf_names}
        leaves = {name: leaf(x.expand(*x.shape[:-1], len(lanes))) for name, x in names.items()}
        with torch.enable_grad():
            condensed = record.condensed_of(dynamics.with_data({**dynamics.data, **leaves}))
        return leaves | dict(zip(_STATE, start, strict=True)), condensed, start

    @cached_property
    def _start(self) -> _Start:
        """The initial state of all lanes that are taken back."""
        return _Start(*self.run.start_of_leaves(self.lanes, self._leaf_names))

    def _initial(self, so_far: _Cotangents, rows: int) -> None:
        """From the initial states, and those at the first point of the grid, to the leaves."""
        segment = self.run.segments[0]
        if so_far.arrival is None and so_far.start is None and so_far.rates is None and not segment.locks:
            return  # the steps led to the leaves
        leaves, made = self._start
        outputs, of_outputs = [made.start.v], [so_far.rates]
        for state, cotangents in ((made.begin, so_far.arrival), (made.state, (so_far.start or [])[1:])):
            outputs += (state or []) if cotangents else []
            of_outputs += cotangents or []
        self._add_marks(made.whole.data, segment, so_far, outputs, of_outputs)
        by_inputs = pulled_back(outputs, of_outputs, list(leaves.leaves.values()), rows, at_once=True)
        for key, cotangent in zip(leaves.leaves, by_inputs, strict=True):
            so_far.add(key, range(len(so_far.lanes)), cotangent)

    def _add_marks(
        self, data: Data, segment: Segment, so_far: _Cotangents, outputs: list[Any], of_outputs: list[Any]
    ) -> None:
        """Add data that the locks of a segment change to outputs of its entry, and their cotangents."""
        for name in MARKED if segment.locks else ():
            if name in data:
                outputs.append(data[name])
                of_outputs.append(so_far.by.pop(("data", name), None))

    def _entry(self, record: PhaseRecord, so_far: _Cotangents, bar: Outputs, rows: int) -> None:
        """From the first points of the grid, and the states after the switch, to the states before it."""
        run, number, lanes = self.run, record.number, so_far.lanes
        whole = replace(run.whole, data=run.records[number - 1].dynamics.data).select_lanes(lanes)
        segment, every = run.segments[number], range(len(lanes))
        with torch.enable_grad():
            leaves = LaneLeaves(run.views, lanes, whole, self._leaf_names)
            before = record.entry.lanes(lanes)
            t, x = leaf(before.t), before.x.map(leaf)
            data = data_with_marks(whole.topology, leaves.dynamics.data, x.q, segment.locks)
            dynamics = lanes_of(record.dynamics, lanes).with_data(data)
            after = run.after(number, leaves.views, every, dynamics, t, x)
            outputs, of_outputs = self._entered(record, so_far, dynamics, t, x, after, bar.states)
            by_t, *by_sides = [None if y is None else rows_first(y, lanes) for y in bar.switches[number - 1]]
            outputs.append(t)
            of_outputs += [None if by_t is None else by_t.reshape(rows, *t.shape), *by_sides]
            for side, y, by_lam in ((number - 1, x, by_sides[3]), (number, after, by_sides[7])):
                lam = y.lam if by_lam is None else run.all_multipliers(side, data, t, y)
                outputs += [y.q, y.v, y.vd, lam]
        self._add_marks(data, segment, so_far, outputs, of_outputs)
        inputs = [t, *x]
        by_inputs = pulled_back(outputs, of_outputs, [*inputs, *leaves.leaves.values()], rows)
        so_far.exit = by_inputs[: len(inputs)]
        for key, cotangent in zip(leaves.leaves, by_inputs[len(inputs) :], strict=True):
            so_far.add(key, every, cotangent)

    def _entered(
        self,
        record: PhaseRecord,
        so_far: _Cotangents,
        dynamics: Dynamics,
        t: Tensor,
        before: State,
        after: State,
        motion: MotionCotangents,
    ) -> tuple[list[Tensor], list[Tensor | None]]:
        """What follows from a switch, with its cotangents: time, state after it, arrivals, points of the grid between."""
        run, lanes = self.run, so_far.lanes
        outputs: list[Tensor] = [] if so_far.start is None else [t, *after]
        of_outputs: list[Tensor | None] = [*(so_far.start or [])]
        first, on_grid = record.first[lanes], record.on_grid[lanes]
        arrivals = so_far.arrival or []
        going_on = lane_numbers(record.goes_on[lanes]) if arrivals else []
        if going_on:
            outputs += record.retained(pick_states(before, going_on))
            of_outputs += [x[..., going_on] for x in arrivals]
        between = run.phase_number[:: run.every, lanes] == record.number
        between &= run.every * torch.arange(len(between))[:, None] < first
        begun = lane_numbers(~record.goes_on[lanes] & (first < len(run.times)))
        stepped, reached = [i for i in begun if not bool(on_grid[i])], None
        if begun and (arrivals or bool(between.any())):
            some = [lanes[i] for i in begun], lanes_of(dynamics, begun), t[:, begun], pick_states(after, begun)
            reached, arrived = self._arrived(record, *some)
            if arrivals:
                outputs += arrived
                of_outputs += [x[..., begun] for x in arrivals]
        for k in lane_numbers(between.any(1)):
            h = float(run.kept_times[k]) - t
            y = record.retained(shortly_after(dynamics.topology, after, h))
            if reached is not None and stepped:
                share = h[:, stepped] / (run.times[first[stepped]] - t[:, stepped])
                ends = pick_states(y, stepped), pick_states(reached, [begun.index(i) for i in stepped])
                y = put_states(y, stepped, on_the_way(*ends, share))
            for i, (part, cotangent) in enumerate(zip((y.q, y.v, y.vd, y.lam), motion, strict=True)):
                if cotangent is not None:
                    outputs.append(part)
                    x = rows_first(self._of_steps(record, i, cotangent[k : k + 1])[0], lanes)
                    of_outputs.append(torch.where(between[k], x, 0.0))
        return outputs, of_outputs

    def _arrived(
        self, record: PhaseRecord, lanes: Sequence[int], dynamics: Dynamics, t: Tensor, after: State
    ) -> tuple[State, State]:
        """Condensed states of lanes at their first points of the grid, as reached and as regular steps go on from them."""
        start, regular, on_grid = record.retained(after), self.run.times[1], record.on_grid[lanes]
        smooth, stepped = self._smooth_start(record, dynamics, start, t), lane_numbers(~on_grid)
        reached, arrived = start, smooth.resized(start, regular)
        if stepped:
            of_lanes = [lanes[i] for i in stepped]
            end, condensed = (
                self.run.times[record.first[of_lanes]][None],
                record.condensed_of(lanes_of(dynamics, stepped)),
            )
            size, part = end - t[:, stepped], smooth.lanes(stepped)
            x, there = part.resized(pick_states(start, stepped), size), pick_states(record.arrival, of_lanes)
            x = step_to(condensed, self.integrator.weights, x, size, end, there)
            reached = put_states(reached, stepped, x)
            arrived = put_states(arrived, stepped, part.resized(x, regular, size))
        return reached, arrived
