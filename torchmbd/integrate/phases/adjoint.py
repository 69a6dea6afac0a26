"""The adjoint of a simulation through phases: from the last phase back to the first, lane by lane.

A phase of a lane is three maps, each the discrete one that was integrated:

    entry    (t*, state before) -> marks of locks, jump, impact, accelerations -> state after -> first point of the grid
    steps    first point of the grid -> ... -> the point at which the last step begins
    exit     that point -> (t*, state at the end of a last step of another size)

Entry and exit are graphs of torch, made again from what was recorded (`PhaseRecord`); variable_step.py makes steps of other
sizes differentiable by the implicit function theorem. Regular steps are those of adjoint.py, of all lanes with the same points
together. Where an event ends a phase, the size h of the last step is that at which its function g vanishes:

    mu = -(cotangent of h) / g_h        cotangents of x and b: mu g_x', mu g_b'

Cotangents have the rows of the responses first: [rows, ...] of a number [...]. None: zero.
Cost: about a simulation for the first row and half of one for each further one, whatever the number of design variables.
Over 300 lines: the three maps above and their transposes are read together.
Checked in tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.integrate.adjoint import INACCURATE, AdjointSolver, Grid, MotionCotangents
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.lane_leaves import Key, LaneLeaves, pull_back, rows_first, shaped, zeros
from torchmbd.integrate.phases.lanes import join_states, pick_lanes
from torchmbd.integrate.phases.run import MultiphaseRun, PhaseRecord
from torchmbd.integrate.phases.switch import data_with_marks
from torchmbd.integrate.pullback import leaf
from torchmbd.integrate.step import Weights
from torchmbd.integrate.variable_step import shortly_after
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.equations import ATTACHED
from torchmbd.results.history import History
from torchmbd.results.state import State

MARKED = tuple(ATTACHED)  # data that locks change


@dataclass
class PhaseCotangents:
    """Cotangents of what a simulation through phases returns.

    motion    of q, v, a, lam [times, n, rows, lanes]
    data      of the data with all marks, by name [component..., rows, lanes]
    switches  for each its time, and q, v, a, lam before and after it [n, rows, lanes]
    """

    motion: MotionCotangents
    data: Mapping[str, Tensor | None]
    switches: Sequence[Sequence[Tensor | None]]


@dataclass
class _LaneCotangents:
    """Cotangents of one lane so far: of the leaves, and of the times and states of the phase in which the adjoint is."""

    lane: int
    by: dict[Key, Tensor] = field(default_factory=dict)  # of the leaves
    exit: list[Tensor] | None = None  # of the time of the exit, and of the parts of the state there
    end: list[Tensor] | None = None  # of the state at the base of the last step
    start: list[Tensor] | None = None  # of the time of the entry, and of the state after the switch
    arrival: list[Tensor] | None = None  # of the state at the first point of the grid

    def add(self, keys: Sequence[Key], cotangents: Sequence[Tensor]) -> None:
        for key, cotangent in zip(keys, cotangents, strict=True):
            self.by[key] = self.by[key] + cotangent if key in self.by else cotangent


@dataclass(eq=False)
class PhaseAdjoint:
    """The adjoint of one multiphase run, of values only.

    integrator       that made the steps
    wanted           names of data by which gradients are wanted
    failed           lanes whose cotangents are zero
    adjoint_solver   makes the AdjointSolver of a grid
    error            estimated relative error of the gradients asked for so far [lanes]
    """

    multiphase: MultiphaseRun
    integrator: OneStep
    wanted: Sequence[str]
    failed: Sequence[int]
    adjoint_solver: Callable[[Grid], AdjointSolver]

    def __post_init__(self) -> None:
        self.h = self.multiphase.duration / self.multiphase.steps
        self.weights: Weights = self.integrator.weights(self.h)
        self.error = torch.zeros(self.multiphase.whole.lanes, dtype=torch.float64)
        locks = any(phase_model.locks for phase_model in self.multiphase.phase_models)
        marks = [name for name in MARKED if locks and name in self.multiphase.data_without_marks]
        self._leaf_names = [*self.wanted, *(name for name in marks if name not in self.wanted)]

    @torch.no_grad()
    def __call__(self, cotangents: PhaseCotangents, rows: int) -> dict[int, dict[Key, Tensor]]:
        """Cotangents by data [rows, component..., 1, 1], designs and mode shapes [rows, 1, ...] of each lane."""
        lanes = [_LaneCotangents(lane) for lane in range(len(self.error)) if lane not in self.failed]
        for one in lanes:
            for name, x in cotangents.data.items():
                if x is not None:
                    one.by["data", name] = rows_first(x, one.lane)
        for record in reversed(self.multiphase.records):
            for one in lanes:
                self._exit(record, one, rows)
            self._steps(record, lanes, cotangents.motion, rows)
            for one in lanes:
                self._entry(record, one, cotangents, rows)
        for lane in torch.nonzero(self.error > INACCURATE)[:, 0].tolist():
            warn(
                f"lane {lane}: the adjoint leaves an error of {float(self.error[lane]):.1e} of its gradients; more steps help, "
                "or gradients='forward'",
            )
        return {one.lane: one.by for one in lanes}

    def _exit(self, record: PhaseRecord, one: _LaneCotangents, rows: int) -> None:
        """From where a lane left a phase to the base of its last step."""
        t, x = record.entry.t[:, [one.lane]], record.start.map(lambda y: pick_lanes(y, [one.lane]))
        one.start, one.end = zeros(rows, [t, *x]), None
        if one.lane not in record.exit:
            return
        assert one.exit is not None
        phase_model = self.multiphase.phase_models[record.number]
        k, base = record.base[one.lane]
        with torch.enable_grad():
            leaves = LaneLeaves(self.multiphase.views, one.lane, record.dynamics, self._leaf_names)
            t, base = leaf(t), base.map(leaf)
            begin = t if k is None else torch.full_like(t, float(self.multiphase.times[k]))
            size = leaf(record.exit[one.lane].t - begin)
            event = phase_model.phase.until if isinstance(phase_model.phase.until, Event) else None
            end = begin + size if event is not None else self.multiphase.end_times(phase_model, t)
            y = self.integrator.step_of_size(leaves.dynamics, base, end - begin if event is None else size, end)
            g = None if event is None else event.of(leaves.views.at([0], leaves.dynamics, end, y))[0]
        inputs = [size, t, *base, *leaves.leaves.values()]
        found = pull_back([end, *y], one.exit, inputs, rows)
        if g is not None:
            slopes = pull_back([g], [torch.ones_like(g)[None]], inputs, 1)
            mu = -found[0].flatten() / slopes[0].flatten()
            found = [
                cotangent + torch.tensordot(mu[:, None], dg, 1) for cotangent, dg in zip(found, slopes, strict=True)
            ]
        _, by_t, *by_state = found[: 2 + len(base)]
        one.start[0] = one.start[0] + by_t
        one.add(list(leaves.leaves), found[2 + len(base) :])
        if k is None:
            one.start[1:] = [a + b for a, b in zip(one.start[1:], by_state, strict=True)]
        else:
            one.end = by_state

    def _steps(
        self, record: PhaseRecord, lanes: Sequence[_LaneCotangents], cotangents: MotionCotangents, rows: int
    ) -> None:
        """From the last regular steps of all lanes to their first points of the grid."""
        groups: dict[tuple[int, int], list[_LaneCotangents]] = {}
        for one in lanes:
            one.arrival = None
            first, in_phase = int(record.first[one.lane]), self.multiphase.phase_number[:, one.lane] == record.number
            base = record.base[one.lane][0] if one.lane in record.base else None
            last = max([first - 1 if base is None else base, *torch.nonzero(in_phase)[:, 0].tolist()])
            if last >= first:
                groups.setdefault((first, last), []).append(one)
        for (first, last), group in groups.items():
            self._steps_of_group(record, range(first, last + 1), group, cotangents, rows)

    def _steps_of_group(
        self,
        record: PhaseRecord,
        points: range,
        group: list[_LaneCotangents],
        cotangents: MotionCotangents,
        rows: int,
    ) -> None:
        """As `_steps`, for lanes with the same first and last point of the grid."""
        multiphase, lanes = self.multiphase, [one.lane for one in group]
        at, phase_model = slice(points.start, points.stop), multiphase.phase_models[record.number]
        h = multiphase.history
        q, v, vd, lam = (x[at, :, :, lanes] for x in (h.q, h.v, h.vd, h.lam[:, phase_model.rows]))
        history = History(q, v, vd, lam)
        in_phase = (multiphase.phase_number[at, lanes] == record.number)[:, None, None]
        of_states = [
            torch.zeros(len(points), n.shape[1], rows, len(lanes), dtype=torch.float64)
            if x is None
            else torch.where(in_phase, (x[:, phase_model.rows] if i == 3 else x)[at, :, :, lanes], 0.0)
            for i, (x, n) in enumerate(zip(cotangents, (q, v, vd, lam), strict=True))
        ]
        by_a = torch.zeros_like(of_states[2][0])
        for i, one in enumerate(group):
            if one.end is not None:
                k = record.base[one.lane][0]
                assert k is not None
                by_a[..., i] = self._add_state(of_states, k - points.start, one.end, i)
        start = join_states([record.arrival[lane] for lane in lanes]).map(leaf)
        if len(points) == 1:
            by_q, by_v, by_vd, by_lam = (x[0] for x in of_states)
            by_start, by_data = State(by_q, by_v, by_vd, by_a, by_lam), {}
        else:
            by_start, by_data = self._adjoint_of_steps(record, points, lanes, history, start, of_states)
            by_start = by_start._replace(a=by_start.a + by_a)
        for i, one in enumerate(group):
            one.arrival = [x[..., i].movedim(-1, 0)[..., None, None] for x in by_start]
            one.add(list(by_data), [x[..., [i]].movedim(-2, 0).unsqueeze(-2) for x in by_data.values()])

    def _add_state(self, of_states: list[Tensor], k: int, end: list[Tensor], lane: int) -> Tensor:
        """Add the cotangents of the state at the point k of one lane to those of the states of the motion.

        The algorithmic acceleration is not among these: a1 = w(v0', v1') + c a0, so it is a sum over all steps before. Returns
        the cotangents of the first one.
        """
        q, v, vd, a, lam = (x[..., 0, 0].T for x in end)
        for x, cotangent in zip(of_states, (q, v, vd, lam), strict=True):
            x[k, :, :, lane] += cotangent
        w = self.weights
        powers = (w.a_from_a ** torch.arange(k, dtype=torch.float64).flip(0))[:, None, None] * a
        of_states[2][:k, :, :, lane] += w.a_from_vd * powers
        of_states[2][1 : k + 1, :, :, lane] += w.share * powers
        return w.a_from_a**k * a

    def _adjoint_of_steps(
        self,
        record: PhaseRecord,
        points: range,
        lanes: list[int],
        history: History,
        start: State,
        cotangents: list[Tensor],
    ) -> tuple[State, dict[Key, Tensor]]:
        """Cotangents [..., rows, lanes] of the state at the first point, and by data."""
        dynamics = record.dynamics.select_lanes(lanes)
        names = {name: dynamics.data[name] for name in self._leaf_names}
        leaves = {name: leaf(x.expand(*x.shape[:-1], len(lanes))) for name, x in names.items()}
        dynamics = replace(dynamics, data={**dynamics.data, **leaves})
        state = {f"state {name}": x for name, x in zip(State._fields, start, strict=True)}
        times = self.multiphase.times[points.start : points.stop]
        corrections = self.integrator.counts(dynamics)[1]
        grid = Grid(lanes, history, leaves | state, dynamics, start, self.weights, times, 1, corrections)
        of_steps, error = self.adjoint_solver(grid)(cotangents)
        self.error[lanes] = self.error[lanes].maximum(error)
        by_leaf = grid.cotangents(of_steps)
        return State(*(by_leaf[name] for name in state)), {("data", name): by_leaf[name] for name in leaves}

    def _entry(self, record: PhaseRecord, one: _LaneCotangents, cotangents: PhaseCotangents, rows: int) -> None:
        """From the first point of the grid, and the state after the switch, to the state before it."""
        multiphase, number, lane = self.multiphase, record.number, one.lane
        data = multiphase.records[number - 1].dynamics.data if number else multiphase.data_without_marks
        whole = replace(multiphase.whole, data=data)
        phase_model = multiphase.phase_models[number]
        with torch.enable_grad():
            leaves = LaneLeaves(multiphase.views, lane, whole, self._leaf_names)
            before = record.entry.lane(lane)
            if number:
                t, x = leaf(before.t), before.x.map(leaf)
            else:
                q, v = multiphase.initial_coordinates(leaves.dynamics)
                t, x = before.t, before.x._replace(q=q, v=v)
            data = data_with_marks(whole.topology, leaves.dynamics.data, x.q, phase_model.locks)
            dynamics = multiphase.dynamics_of(number, replace(leaves.dynamics, data=data))
            after = multiphase.after(number, leaves.views, 0, dynamics, t, x)
            outputs, of_outputs = self._entered(record, one, dynamics, t, after, cotangents.motion)
            if number:
                sides = [(number - 1, x), (number, after)]
                outputs.append(t)
                for side, y in sides:
                    outputs += [y.q, y.v, y.vd, multiphase.all_multipliers(side, data, t, y.q, y.lam)]
                own = cotangents.switches[number - 1]
                of_outputs += [None if y is None else rows_first(y, lane) for y in own]
                of_outputs[len(of_outputs) - len(own)] = shaped(of_outputs[len(of_outputs) - len(own)], t)
        for name in MARKED if phase_model.locks else ():
            if name in data:
                outputs.append(data[name])
                of_outputs.append(one.by.pop(("data", name), None))
        inputs = [t, *x] if number else []
        by_inputs = pull_back(outputs, of_outputs, [*inputs, *leaves.leaves.values()], rows)
        one.exit = by_inputs[: len(inputs)]
        one.add(list(leaves.leaves), by_inputs[len(inputs) :])

    def _entered(
        self,
        record: PhaseRecord,
        one: _LaneCotangents,
        dynamics: Dynamics,
        t: Tensor,
        after: State,
        motion: MotionCotangents,
    ) -> tuple[list[Tensor], list[Tensor | None]]:
        """What follows from a switch, with its cotangents: time, state after it, the arrival, points of the grid between."""
        multiphase, lane, phase_model = self.multiphase, one.lane, self.multiphase.phase_models[record.number]
        assert one.start is not None
        outputs: list[Tensor] = [t, *after]
        of_outputs: list[Tensor | None] = [*one.start]
        first = int(record.first[lane])
        if one.arrival is not None:
            end = torch.full_like(t, float(multiphase.times[min(first, multiphase.steps)]))
            direct = record.on_grid[lane]
            outputs += after if direct else self.integrator.step_of_size(dynamics, after, end - t, end)
            of_outputs += one.arrival
        in_phase = multiphase.phase_number[:first, lane] == record.number
        for k in torch.nonzero(in_phase)[:, 0].tolist():
            y = shortly_after(dynamics.topology, after, float(multiphase.times[k]) - t)
            for i, (part, cotangent) in enumerate(zip((y.q, y.v, y.vd, y.lam), motion, strict=True)):
                if cotangent is not None:
                    outputs.append(part)
                    of_outputs.append(rows_first((cotangent[:, phase_model.rows] if i == 3 else cotangent)[k], lane))
        return outputs, of_outputs
