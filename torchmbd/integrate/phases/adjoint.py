"""The adjoint of a simulation through phases: from the last phase back to the first.

A phase of a lane is three maps, each the discrete one that was integrated:

    entry    (t*, state before) -> marks of locks, jump, impact, accelerations -> state after -> first point of the grid
    steps    first point of the grid -> ... -> the point at which the last step begins
    exit     that point -> (t*, state at the end of a last step of another size)

Entry and exit are graphs of torch of all lanes, each at its own time, made again from what was recorded (`PhaseRecord`);
steps of other sizes are differentiable by the implicit function theorem (`step_to` of variable_step.py). Regular steps are
those of adjoint.py, of all lanes with the same points together. Where an event ends a phase, the size h of the last step is
that at which its function g vanishes:

    mu = -(cotangent of h) / g_h        cotangents of x and b: mu g_x', mu g_b'

Cotangents have the rows of the responses first: [rows, ...] of a number [...]. None: zero.
Cost: about a simulation for the first row and half of one for each further one, whatever the number of design variables.
Checked in tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.adjoint import warn_inaccurate
from torchmbd.integrate.adjoint_solver import Grid, MotionCotangents
from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.lanes import expanded, lane_numbers, lanes_of, pick_states
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.outputs import Outputs
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.lane_leaves import Key, LaneLeaves, add_lanes, by_lanes, pulled_back, rows_first, zeros
from torchmbd.integrate.phases.last_steps import without_rate
from torchmbd.integrate.phases.phase_record import PhaseRecord
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.phases.switch import data_with_marks
from torchmbd.integrate.pullback import leaf
from torchmbd.integrate.step import Weights
from torchmbd.integrate.variable_step import shortly_after, step_to
from torchmbd.multibody.equations.equations import ATTACHED
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History
from torchmbd.results.state import State

MARKED = tuple(ATTACHED)  # data that locks change


@dataclass
class _Cotangents:
    """Cotangents so far: of the leaves, and of the times and states of the phase in which the adjoint is.

    lanes    those that have not failed
    by       of the leaves of these lanes
    exit     of the times of the exits, and of the parts of the states there
    end      of the states at the bases of the last steps
    start    of the times of the entries, and of the states after the switch
    arrival  of the states at the first points of the grid
    """

    lanes: list[int]
    by: dict[Key, Tensor] = field(default_factory=dict)
    exit: list[Tensor] = field(default_factory=list)
    end: list[Tensor] = field(default_factory=list)
    start: list[Tensor] = field(default_factory=list)
    arrival: list[Tensor] = field(default_factory=list)

    def add(self, key: Key, lanes: Sequence[int], cotangent: Tensor) -> None:
        """Add cotangents [rows, ...] of some of the lanes, counted among these."""
        if key not in self.by:
            shape = list(cotangent.shape)
            shape[-1 if key[0] == "data" else 1] = len(self.lanes)
            self.by[key] = cotangent.new_zeros(shape)
        add_lanes(self.by[key], key[0], lanes, cotangent)


@dataclass(eq=False)
class PhaseAdjoint:
    """The adjoint of one multiphase run, of values only.

    names    of data by which gradients are wanted
    failed   lanes whose cotangents are zero
    error    estimated relative error of the gradients asked for so far [lanes]
    """

    multiphase: MultiphaseRun
    names: Sequence[str]
    failed: Sequence[int]

    def __post_init__(self) -> None:
        self.h = self.multiphase.duration / self.multiphase.steps
        self.integrator: OneStep = self.multiphase.integrator
        self.weights: Weights = self.integrator.weights(self.h)
        self.error = torch.zeros(self.multiphase.whole.lanes, dtype=torch.float64)
        locks = any(segment.locks for segment in self.multiphase.segments)
        marks = [name for name in MARKED if locks and name in self.multiphase.data_without_marks]
        self._leaf_names = [*self.names, *(name for name in marks if name not in self.names)]

    @torch.no_grad()
    def __call__(self, bar: Outputs, rows: int) -> tuple[list[int], dict[Key, Tensor]]:
        """Lanes, and their cotangents by data [rows, component..., 1, lanes], designs and mode shapes [rows, lanes, ...].

        bar   cotangents of states at all steps, of data with all marks, and of switches (None: zero)
        """
        so_far = _Cotangents([lane for lane in range(len(self.error)) if lane not in self.failed])
        if not so_far.lanes:
            return [], {}
        for name, x in bar.data.items():
            if x is not None:
                so_far.by["data", name] = rows_first(x, so_far.lanes).clone()
        for record in reversed(self.multiphase.records):
            self._exit(record, so_far, rows)
            self._steps(record, so_far, bar.states, rows)
            self._entry(record, so_far, bar, rows)
        warn_inaccurate(self.error)
        return so_far.lanes, so_far.by

    def _exit(self, record: PhaseRecord, so_far: _Cotangents, rows: int) -> None:
        """From where lanes left a phase to the bases of their last steps."""
        entry, start = record.entry.t[:, so_far.lanes], pick_states(record.start, so_far.lanes)
        base, c = pick_states(record.base, so_far.lanes), record.condensation
        so_far.start, so_far.end = zeros(rows, [entry, *start]), zeros(rows, base)
        indices = [i for i, lane in enumerate(so_far.lanes) if record.has_exit[lane]]  # counted among those of so_far
        if not indices:
            return
        lanes = [so_far.lanes[i] for i in indices]
        segment = self.multiphase.segments[record.number]
        k, there = record.base_point[lanes], record.exit.lanes(lanes)
        with torch.enable_grad():
            leaves = LaneLeaves(self.multiphase.views, lanes, lanes_of(record.dynamics, lanes), self._leaf_names)
            dynamics = _condensed(record, leaves.dynamics)
            t, base = leaf(entry[:, indices]), pick_states(base, indices).map(leaf)
            begin = torch.where(k < 0, t, self.multiphase.times[k.clamp_min(0)])
            size = leaf(there.t - begin)
            event = segment.phase.until if isinstance(segment.phase.until, Event) else None
            end = begin + size if event is not None else self.multiphase.end_times(segment, t, leaves.dynamics.data)
            of_size = size if event is not None else end - begin
            y = step_to(dynamics, self.integrator.weights, base, of_size, end, record.retained(there.x))
            y = record.whole(y, end)
            g = None if event is None else leaves.views.of_lanes(event, leaves.dynamics, end, y)
        keys, inputs = list(leaves.leaves), [size, t, *base, *leaves.leaves.values()]
        kinds = ["data"] * (2 + len(base)) + [kind for kind, _ in keys]  # where their lanes are
        cotangents = pulled_back([end, *y], [x[..., indices] for x in so_far.exit], inputs, rows)
        if g is not None:
            slopes = pulled_back([g], [torch.ones_like(g)[None]], inputs, 1)
            if bool((slopes[0] == 0.0).any()):
                raise InputError(without_rate(segment.name))
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

    def _steps(self, record: PhaseRecord, so_far: _Cotangents, cotangents: MotionCotangents, rows: int) -> None:
        """From the last regular steps of all lanes to their first points of the grid."""
        so_far.arrival = [torch.zeros_like(x) for x in so_far.end]
        groups: dict[tuple[int, int, int], list[int]] = {}  # lanes counted among those of so_far
        for i, lane in enumerate(so_far.lanes):
            first, base = int(record.first[lane]), int(record.base_point[lane])
            in_phase = torch.nonzero(self.multiphase.phase_number[:, lane] == record.number)[:, 0]
            last = max([first - 1, base, *in_phase[-1:].tolist()])
            if last >= first:
                groups.setdefault((first, base, last), []).append(i)
        for (first, base, last), group in groups.items():
            self._steps_of_group(record, range(first, last + 1), base - first, group, so_far, cotangents, rows)

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
        multiphase, lanes = self.multiphase, [so_far.lanes[i] for i in group]
        every, c = multiphase.every, record.condensation
        phase_rows = multiphase.segments[record.number].rows
        rows_of_steps = phase_rows if c is None else [phase_rows[k] for k in c.rows.tolist()]
        at = slice(-(-points.start // every), points[-1] // every + 1)
        h = multiphase.history
        q, v, vd, lam = (x[at, :, :, lanes] for x in (h.q, h.v, h.vd, h.lam[:, rows_of_steps]))
        if c is not None:
            q, v, vd = q[:, c.coordinates], v[:, c.independent], vd[:, c.independent]
        history = History(q, v, vd, lam)
        kept = slice(at.start * every, points.stop, every)
        in_phase = (multiphase.phase_number[kept, lanes] == record.number)[:, None, None]
        of_states = []
        for i, (x, n) in enumerate(zip(cotangents, history.states, strict=True)):
            if x is None:
                of_states.append(torch.zeros(len(n), n.shape[1], rows, len(lanes), dtype=torch.float64))
                continue
            of_points = torch.where(in_phase, (x[:, rows_of_steps] if i == 3 else x)[at, :, :, lanes], 0.0)
            of_states.append(of_points if c is None or i == 3 else c.of_whole(i, of_points))
        end = State(*(x[..., 0, group].movedim(0, -2) for x in so_far.end))
        start = pick_states(record.arrival, lanes).map(leaf)
        if len(points) == 1:
            by_start, by_data = end if base == 0 else end.map(torch.zeros_like), {}
            if len(of_states[0]):
                by_q, by_v, by_vd, by_lam = (x[0] for x in of_states)
                q, v, vd, a, lam = by_start
                by_start = State(q + by_q, v + by_v, vd + by_vd, a, lam + by_lam)
        else:
            grid = self._grid(record, points, base, lanes, history, start)
            more = {base: end} if base > 0 else {}
            of_steps, error = backend_of(grid.dynamics).adjoint_solver(grid)(of_states, more)
            self.error[lanes] = self.error[lanes].maximum(error)
            by_leaf = grid.cotangents(of_steps)
            by_start = State(*(by_leaf.pop(f"state {name}") for name in State._fields))
            if base == 0:
                by_start = State(*(x + y for x, y in zip(by_start, end, strict=True)))
            by_data = {("data", name): x for name, x in by_leaf.items()}
        for total, x in zip(so_far.arrival, by_start, strict=True):
            total[..., group] = x.movedim(-2, 0).unsqueeze(-2)
        for key, x in by_data.items():
            so_far.add(key, group, x.movedim(-2, 0).unsqueeze(-2))

    def _grid(
        self, record: PhaseRecord, points: range, base: int, lanes: list[int], history: History, start: State
    ) -> Grid:
        """The regular steps of some lanes; leaves are the data and the state at the first point."""
        dynamics = record.dynamics.select_lanes(lanes)
        names = {name: dynamics.data[name] for name in self._leaf_names}
        leaves = {name: leaf(x.expand(*x.shape[:-1], len(lanes))) for name, x in names.items()}
        dynamics = dynamics.with_data({**dynamics.data, **leaves})
        with torch.enable_grad():
            dynamics = _condensed(record, dynamics)
        state = {f"state {name}": x for name, x in zip(State._fields, start, strict=True)}
        times, every = self.multiphase.times[points.start : points.stop], self.multiphase.every
        offset, cuts, starts = -points.start % every, [base] if 0 < base < len(points) - 1 else [], None
        if every > 1:
            starts = {0: start.map(Tensor.detach)}
            for k, a in record.checkpoints.items():
                if points.start < k < points[-1]:
                    q, v, vd, lam = (x[(k - points.start - offset) // every] for x in history.states)
                    starts[k - points.start] = State(q, v, vd, a[..., lanes], lam)
        return Grid(
            lanes=lanes,
            history=history,
            leaves=leaves | state,
            dynamics=dynamics,
            start=start,
            weights=self.weights,
            times=times,
            integrator=self.integrator,
            corrections=self.integrator.counts(dynamics)[1],
            every=every,
            offset=offset,
            first=points.start,
            starts=starts,
            restarts=[k - points.start for k in record.restarts if points.start < k < points[-1]],
            cuts=cuts,
        )

    def _entry(self, record: PhaseRecord, so_far: _Cotangents, bar: Outputs, rows: int) -> None:
        """From the first points of the grid, and the states after the switch, to the states before it."""
        multiphase, number, lanes = self.multiphase, record.number, so_far.lanes
        data = multiphase.records[number - 1].dynamics.data if number else multiphase.data_without_marks
        whole = replace(multiphase.whole, data=data).select_lanes(lanes)
        segment, every = multiphase.segments[number], range(len(lanes))
        with torch.enable_grad():
            leaves = LaneLeaves(multiphase.views, lanes, whole, self._leaf_names)
            before = record.entry.lanes(lanes)
            if number:
                t, x = leaf(before.t), before.x.map(leaf)
            else:
                q, v = (expanded(y, len(lanes)) for y in multiphase.initial_coordinates(leaves.dynamics))
                t, x = before.t, before.x._replace(q=q, v=v)
            data = data_with_marks(whole.topology, leaves.dynamics.data, x.q, segment.locks)
            dynamics = lanes_of(record.dynamics, lanes).with_data(data)
            after = multiphase.after(number, leaves.views, every, dynamics, t, x)
            outputs, of_outputs = self._entered(record, so_far, dynamics, t, after, bar.states)
            if number:
                by_t, *by_sides = [None if y is None else rows_first(y, lanes) for y in bar.switches[number - 1]]
                outputs.append(t)
                of_outputs += [None if by_t is None else by_t.reshape(rows, *t.shape), *by_sides]
                for side, y, by_lam in ((number - 1, x, by_sides[3]), (number, after, by_sides[7])):
                    lam = y.lam if by_lam is None else multiphase.all_multipliers(side, data, t, y)
                    outputs += [y.q, y.v, y.vd, lam]
        for name in MARKED if segment.locks else ():
            if name in data:
                outputs.append(data[name])
                of_outputs.append(so_far.by.pop(("data", name), None))
        inputs = [t, *x] if number else []
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
        after: State,
        motion: MotionCotangents,
    ) -> tuple[list[Tensor], list[Tensor | None]]:
        """What follows from a switch, with its cotangents: time, state after it, arrivals, points of the grid between."""
        multiphase, lanes, segment = self.multiphase, so_far.lanes, self.multiphase.segments[record.number]
        outputs: list[Tensor] = [t, *after]
        of_outputs: list[Tensor | None] = [*so_far.start]
        first, on_grid = record.first[lanes], record.on_grid[lanes]
        direct = lane_numbers(on_grid)
        if direct:
            outputs += record.retained(pick_states(after, direct))
            of_outputs += [x[..., direct] for x in so_far.arrival]
        indices = lane_numbers(~on_grid & (first < len(multiphase.times)))
        if indices:
            end, begin = multiphase.times[first[indices]][None], t[:, indices]
            arrival = pick_states(record.arrival, [lanes[i] for i in indices])
            some = _condensed(record, lanes_of(dynamics, indices))
            x = record.retained(pick_states(after, indices))
            outputs += step_to(some, self.integrator.weights, x, end - begin, end, arrival)
            of_outputs += [x[..., indices] for x in so_far.arrival]
        between = multiphase.phase_number[:: multiphase.every, lanes] == record.number
        between &= multiphase.every * torch.arange(len(between))[:, None] < first
        for k in lane_numbers(between.any(1)):
            y = shortly_after(dynamics.topology, after, float(multiphase.kept_times[k]) - t)
            for i, (part, cotangent) in enumerate(zip((y.q, y.v, y.vd, y.lam), motion, strict=True)):
                if cotangent is not None:
                    outputs.append(part)
                    x = rows_first((cotangent[:, segment.rows] if i == 3 else cotangent)[k], lanes)
                    of_outputs.append(torch.where(between[k], x, 0.0))
        return outputs, of_outputs


def _condensed(record: PhaseRecord, dynamics: Dynamics) -> Dynamics:
    """The dynamics of the steps of a phase, of some lanes of it with other data."""
    return dynamics if record.condensation is None else dynamics.condensed().share_rank(record.condensed)
