"""The record of a motion through its phases, whatever the integrator: states on the grid, switches, status of lanes.

A motion is recorded on one grid of times for all lanes. Lanes pass from phase to phase at their own times t*, between those of
the grid. A `PhaseExit` has these times and the states there, with *total* derivatives with respect to the design; a `Switch`
shows them to the user. On the grid, derivatives are taken at fixed times.
Checked in tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.contacts import ContactWatch
from torchmbd.integrate.lanes import lane_numbers, lanes_of, pick_lanes, pick_states, put_lanes, put_states
from torchmbd.integrate.phases.events import Event, Views
from torchmbd.integrate.phases.lane_leaves import LaneLeaves
from torchmbd.integrate.phases.phase_record import PhaseExit, PhaseRecord
from torchmbd.integrate.phases.segment import DURATION, Segment, keep_equations
from torchmbd.integrate.phases.switch import (
    InitialState,
    data_with_marks,
    entered,
    jump,
    laws_jump,
    velocities_after_impact,
)
from torchmbd.integrate.prepared import Prepared, detached, of_leaves, prepare, prepare_whole
from torchmbd.math.gradients import untransformed
from torchmbd.math.pair import Pair, linear, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.sizes import row_sizes
from torchmbd.multibody.equations.times_as_lanes import at_own_times, at_time
from torchmbd.multibody.saddle import reactions
from torchmbd.multibody.saddle.expansion import Expansion
from torchmbd.multibody.saddle.least_norm import LeastNorm
from torchmbd.multibody.start.start import EquilibriumConditions
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History, Record
from torchmbd.results.motion_data import Moment, Switch
from torchmbd.results.state import State

CLOSED = 1e-6  # share of the size of a row: violation of a joint that begins to act


@dataclass
class MultiphaseRun:
    """One simulation through all phases.

    whole   dynamics of the system with all joints and locks; its data receive the marks of the locks
    integrator  that makes the steps
    every   steps between two states that are kept: all between them are made again for the adjoint

    States that are recorded are those of `recorded`: of the whole, or, where all segments have its equations, of the regular
    steps.
    """

    whole: Dynamics
    segments: Sequence[Segment]
    views: Views
    duration: float
    steps: int
    integrator: Any
    every: int = 1
    switches: list[Switch] = field(default_factory=list)
    records: list[PhaseRecord] = field(default_factory=list)

    def __post_init__(self) -> None:
        lanes = self.whole.lanes
        self.times = torch.linspace(0.0, self.duration, self.steps + 1, dtype=torch.float64)
        self.failures = [""] * lanes  # the first reason why a lane has failed
        self.failed_for_good: set[int] = set()  # lanes that would with smaller steps as well
        self.doubts: dict[int, str] = {}  # of lanes whose numbers stay
        made = self._first_segment(self.whole)
        self.start_as_made: Prepared | None = made  # a function of leaves, where there are any
        for lane, reason in self.whole.start_errors.items():
            self.fail(lane, reason)
        self.first, self.whole = made.detached(), detached(self.whole)
        self.data_without_marks = self.whole.data
        same = self.first.whole.topology is self.whole.topology
        self.whole = self.first.whole if same else self.whole.with_data(self.first.whole.data)
        self.keeps_equations = keep_equations(self.segments, self.whole.topology)
        self.recorded = self.first.condensed if self.keeps_equations else self.whole
        # Whether the time at which a phase begins depends on the design.
        self.begin_depends = [False]
        for number in range(len(self.segments) - 1):
            self.begin_depends.append(self.end_depends(number))
        self.entered: list[Prepared] = []
        self._least_norm: dict[int, LeastNorm | None] = {}
        self.states = Record.of_dynamics(self.recorded, self.steps // self.every + 1)
        self.q, self.v, self.vd, self.lam = self.states.parts
        self.kept_times = self.times[:: self.every]  # of the states that are kept
        self.views = self.views.continuing(self.kept_times, self.q, self._recorded_states)
        self.phase_number = torch.full((self.steps + 1, lanes), -1, dtype=torch.int32)  # kept with the motion
        self.watch = ContactWatch(self.whole, self.steps)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"start_as_made": None}  # may have a graph of torch

    def _first_segment(self, whole: Dynamics) -> Prepared:
        """Dynamics of the first segment and of its regular steps, and its initial states, as functions of data of `whole`."""
        segment, dynamics = self.segments[0], whole
        if segment.topology is not whole.topology:
            dynamics = replace(whole, topology=segment.topology, saddle=segment.saddle, initial=segment.initial)
        t = self._wide(torch.zeros(1, whole.lanes, dtype=torch.float64), whole.lanes)
        with of_leaves(whole):
            if segment.locks:
                made = self._locked(whole, dynamics, t)  # without leaves: the adjoint needs them before locks take hold
            else:
                made = (prepare if self.integrator.condenses else prepare_whole)(dynamics)
                whole.start_errors.update(dynamics.start_errors)  # of the problem
            return made.with_begin(self.integrator, t, self.grid_times(torch.tensor(1), t))

    def _locked(self, whole: Dynamics, dynamics: Dynamics, t: Any) -> Prepared:
        """As `_first_segment`, with locks that hold the joints as they are closed; t [1 + n, lanes]: zero."""
        segment = self.segments[0]
        q, v = (self._wide(x, whole.lanes) for x in self._closed_coordinates(whole))
        data = data_with_marks(whole.topology, whole.data, q, segment.locks)
        initial = InitialState(
            value(q)[..., :1].detach(), value(v)[..., :1].detach(), self.whole.initial.size, None, segment.condensation
        )
        dynamics = replace(dynamics, data=data, initial=initial)
        of_steps = dynamics.condensed() if self.integrator.condenses else dynamics
        before = State(q, v, v * 0.0, v * 0.0, v[:0])
        lanes = lane_numbers(torch.isfinite(value(q)).flatten(0, 1).all(0))
        state = self._entered(0, lanes, dynamics, PhaseExit(t, before))
        retained = state if of_steps is dynamics else of_steps.initial.condensation.retained_state(state)
        return Prepared(dynamics, of_steps, retained, state)

    def end_depends(self, number: int) -> bool:
        """True if the time at which a phase ends depends on the design."""
        segment, data = self.segments[number], self.whole.data
        if segment.ends_by_event or DURATION in data or segment.time_name in data:
            return True
        return segment.phase.until is None and self.begin_depends[number]

    @property
    def duration_moves(self) -> bool:
        """True if tangents are those by the duration as well: points of the grid move with it."""
        return isinstance(self.whole.data.get(DURATION), Pair)

    def grid_times(self, points: Tensor, like: Any) -> Any:
        """Times [1 + n, lanes] of points of the grid [lanes] or [], as numbers like others."""
        t = like * 0.0 + self.times[points].expand_as(value(like))
        if not self.duration_moves:
            return t
        return Pair.of(value(t), self.whole.data[DURATION].tangent * (points / self.steps).expand_as(value(like)))

    @property
    def history(self) -> History:
        """The motion at the times that are kept."""
        segment = None if self.keeps_equations else self.phase_number[:: self.every, None].double()
        return replace(self.states.history(self._expansion(self.kept_times)), segment=segment, run=self)

    def _expansion(self, times: Tensor) -> Expansion | None:
        """Leads from states that are recorded at these times to those of the whole; None: they are its own."""
        if self.recorded.topology is self.whole.topology:
            return None
        return Expansion.of(self.recorded.initial.condensation, self.whole.data, times)

    def _recorded_states(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """q and v of the whole [times, n, pair, lanes] as they are recorded at some of the times that are kept."""
        states = History(*(x[rows] for x in self.states.parts), expansion=self._expansion(self.kept_times[rows]))
        return states.rows(0), states.rows(1)

    def multipliers(self, history: History, data: Data | None = None) -> Tensor:
        """Multipliers of all rows [times, rows, pair, lanes] of states; of redundant ones those of least norm.

        data   instead of those of the whole
        """
        lam, data, segment = history.lam, data or self.whole.data, history.segment
        at = self.kept_times if history.times is None else history.times
        assert segment is not None
        for record, least in ((record, self.least_norm(record.number)) for record in self.records):
            in_phase = segment == record.number
            times = (untransformed(segment) == record.number).flatten(-2).any(-1).reshape(-1, len(at)).any(0)
            if (least is None and record.condensation is None) or not bool(times.any()):
                continue
            q, v, a, multipliers = history.q[times], history.v[times], history.vd[times], lam[times]
            if (c := record.condensation) is not None:
                rows = torch.tensor(self.segments[record.number].rows, dtype=torch.long)
                of_phase = reactions.multipliers(c, data, at[times], q, v, a, multipliers[:, rows[c.rows]])
                multipliers = torch.zeros_like(multipliers).index_copy(1, rows, of_phase)
            if least is not None:
                multipliers = least.at_times(data, at[times], q, multipliers)
            lam = lam.index_put((times,), torch.where(in_phase[times][:, None], multipliers, lam[times]))
        return lam

    def start(self) -> PhaseExit:
        """Where the first segment begins."""
        lanes = self.whole.lanes
        return PhaseExit(self._wide(torch.zeros(1, lanes, dtype=torch.float64), lanes), self.first.state)

    @property
    def initial_rates(self) -> Any:
        """Rates of the recorded states at the start; those of the first step may differ (smooth_start.py)."""
        return (self.first.start if self.keeps_equations else self.first.state).v

    def start_of_leaves(self, lanes: Sequence[int], names: Sequence[str]) -> tuple[LaneLeaves, Prepared]:
        """Data of these names as leaves, and the initial state of some lanes and the dynamics of the first segment as
        functions of these: as the motion had them where it was made of leaves."""
        record, made = self.records[0], self.start_as_made
        if (
            made is not None
            and names
            and set(names).issubset(made.leaves)
            and list(lanes) == list(range(self.whole.lanes))
        ):
            made.condensed.share_rank(record.condensed)
            return LaneLeaves(self.views, lanes, made.whole, names, are_made=True), made
        leaves = LaneLeaves(self.views, lanes, lanes_of(self.whole.with_data(self.data_without_marks), lanes), names)
        made = self._first_segment(leaves.dynamics)
        made.condensed.share_rank(record.condensed)
        return leaves, made

    def _closed_coordinates(self, whole: Dynamics) -> tuple[Any, Any]:
        """Initial q and v with closed joints, before locks take hold, as functions of the data of `whole`."""
        segment = self.segments[0]
        (T, saddle), initial = segment.closing, segment.initial
        free = replace(whole, topology=T, saddle=saddle, initial=initial)
        if not isinstance(initial, EquilibriumConditions):
            return initial.solve(free)
        q, v = initial.assembled(free)  # locks hold these positions while bodies sag
        held = replace(
            whole, data=data_with_marks(whole.topology, whole.data, self._wide(q, whole.lanes), segment.locks)
        )
        held = replace(held, topology=segment.topology, saddle=segment.saddle)
        q = initial.equilibrium_near(held, q)
        whole.start_errors.update(held.start_errors)
        return q, initial.compatible(replace(free, data=held.data), q, v)

    def _wide(self, x: Any, lanes: int) -> Any:
        """A number with so many lanes and all tangents."""
        n = self.whole.tangents
        if isinstance(x, Pair) or not n:
            return linear(lambda y: y.expand(*y.shape[:-1], lanes), x)
        return Pair.of(x, x.new_zeros(*x.shape[:-2], n, lanes))

    def enter(self, number: int, phase_exit: PhaseExit) -> Prepared:
        """The dynamics of a phase, those of its regular steps, and the state in which its lanes begin, with consistent
        accelerations."""
        if not number:
            self.entered.append(self.first)
            return self.first
        data = data_with_marks(self.whole.topology, self.whole.data, phase_exit.x.q, self.segments[number].locks)
        if data is not self.whole.data:
            self.whole = replace(self.whole, data=data)
        dynamics, of_steps = self._dynamics_of(number)
        state, t = self._state_after(number, dynamics, phase_exit), phase_exit.t
        retained = state if of_steps is dynamics else of_steps.initial.condensation.retained_state(state)
        self.entered.append(Prepared(dynamics, of_steps, retained, state))
        self.switches.append(
            Switch(
                self.segments[number].name,
                value(t)[0],
                _moment(phase_exit.x, self._multipliers(number - 1, t, phase_exit.x)),
                _moment(state, self._multipliers(number, t, state)),
                t.tangent.T if isinstance(t, Pair) else None,
            )
        )
        return self.entered[-1]

    def goes_on(self, number: int, dynamics: Dynamics, phase_exit: PhaseExit) -> Tensor:
        """Which lanes enter a phase whose equations and laws are those of before, at times at which no law jumps [lanes]."""
        result = torch.zeros(self.whole.lanes, dtype=torch.bool)
        segment, before = self.segments[number], self.segments[number - 1] if number else None
        lanes = lane_numbers(self.entered_lanes(phase_exit))
        if lanes and before is not None and before.phase.impact is None and segment.has_equations_of(before):
            t, x = phase_exit.lanes(lanes)
            h = self.duration / self.steps
            result[lanes] = ~laws_jump(lanes_of(dynamics, lanes).values(), value(t), h, x.values())
        return result

    def _dynamics_of(self, number: int) -> tuple[Dynamics, Dynamics]:
        """The dynamics of a phase and those of its regular steps: of an earlier phase with the same equations and data."""
        segment = self.segments[number]
        for record in self.records:
            if record.dynamics.topology is segment.topology and record.dynamics.data is self.whole.data:
                return record.dynamics, record.condensed
        x, shared = (
            self.first.state,
            None if any(part.locks for part in self.segments) else self.first.whole.shared_start,
        )
        initial = InitialState(
            value(x.q)[..., :1], value(x.v)[..., :1], self.whole.initial.size, shared, segment.condensation
        )
        dynamics = replace(self.whole, topology=segment.topology, saddle=segment.saddle, initial=initial)
        return dynamics, dynamics.condensed() if self.integrator.condenses else dynamics

    def _multipliers(self, number: int, t: Any, x: State) -> Any:
        """Multipliers of all rows [rows, ...] on one side of a switch, of redundant ones those of least norm."""
        lanes, lam = lane_numbers(torch.isfinite(value(t)[0])), x.v[:1] * 0.0
        lam = linear(lambda y: y.new_full((self.whole.topology.rows, *y.shape[1:]), torch.nan), lam)
        if not lanes:
            return lam
        data = lanes_of(self.whole, lanes).data
        return put_lanes(lam, lanes, self.all_multipliers(number, data, pick_lanes(t, lanes), pick_states(x, lanes)))

    def all_multipliers(self, number: int, data: Data, t: Any, x: State) -> Any:
        """Multipliers of all rows from those of a phase or of its condensed system, of redundant ones those of least norm."""
        least, c = self.least_norm(number), self.segments[number].condensation
        lam = reactions.multipliers_at(c, data, t, x.q, x.v, x.vd, x.lam)
        n, rows = self.whole.topology.rows, torch.tensor(self.segments[number].rows, dtype=torch.long)
        lam = linear(lambda y: y.new_zeros(n, *y.shape[1:]).index_copy(0, rows, y), lam)
        return lam if least is None else least.at_varying_time(data, t, x.q, lam)

    def least_norm(self, number: int) -> LeastNorm | None:
        """Projection of the multipliers of a phase, among all rows of the whole; None if all are determined."""
        if number not in self._least_norm:
            self._least_norm[number] = _least_norm(self.whole, self.segments[number], self.entered[number].whole)
        return self._least_norm[number]

    def _state_after(self, number: int, dynamics: Dynamics, phase_exit: PhaseExit) -> State:
        """The state of all lanes after the switch into a phase; nan where they do not get there."""
        x = phase_exit.x
        for lane in lane_numbers(~torch.isfinite(value(x.q)).flatten(0, 1).all(0)):
            self.fail(lane, f"the motion is not finite when phase {self.segments[number].name!r} begins")
        lanes = lane_numbers(self.entered_lanes(phase_exit))
        if lanes:
            entering = phase_exit.lanes(lanes)
            self._check_closed(number, lanes, lanes_of(dynamics, lanes), entering.t, entering.x.q)
        return self._entered(number, lanes, dynamics, phase_exit)

    def _entered(self, number: int, lanes: Sequence[int], dynamics: Dynamics, before: PhaseExit) -> State:
        """The state of lanes after the switch that begins a phase; nan in the others."""
        q, v = before.x.q * torch.nan, before.x.v * torch.nan
        rows = value(q).new_zeros(dynamics.topology.rows, *q.shape[1:])
        state = State(q, v, v, v, Pair(rows) if isinstance(q, Pair) else rows)
        if not lanes:
            return state
        return put_states(
            state, lanes, self.after(number, self.views, lanes, lanes_of(dynamics, lanes), *before.lanes(lanes))
        )

    def after(self, number: int, views: Views, lanes: Sequence[int], dynamics: Dynamics, t: Any, x: State) -> State:
        """The state of some lanes after the switch that begins a phase, from the state before it."""
        ended = self.segments[number - 1].phase if number else None
        impact = ended.impact if ended is not None and isinstance(ended.until, Event) else None
        if ended is None or not isinstance(ended.until, Event) or impact is None:
            v, a, lam = at_time(entered, dynamics, t, x.q, x.v)  # also where the rate of a drive jumps
        else:
            (v,) = at_time(jump, dynamics, t, x.q, x.v)
            v = velocities_after_impact(impact, ended.until, views, lanes, dynamics, t, x._replace(v=v))
            a, lam = at_time(Dynamics.accelerations, dynamics, t, x.q, v)
        return State(x.q, v, a, a, dynamics.zero_left_out(lam))

    def _check_closed(self, number: int, lanes: Sequence[int], dynamics: Dynamics, t: Any, q: Any) -> None:
        """Fail lanes in which a joint begins to act that is not closed."""
        T, before = dynamics.topology, set(self.segments[number - 1].rows)
        new = [k for k, row in enumerate(self.segments[number].rows) if row not in before]
        if not new:
            return
        values, now = {name: value(x) for name, x in dynamics.data.items()}, value(t)
        at = equations.placement(T, values, value(q), at_own_times(T, now, values))
        phi, sizes = equations.constraints(T, at).abs()[new, 0], row_sizes(T, dynamics.initial.size)[new, 0, 0]
        for i in lane_numbers((phi > CLOSED * sizes[:, None]).any(0)):
            k = int((phi[:, i] / sizes).argmax())
            self.fail(
                lanes[i],
                f"{T.row_names[new[k]]} misses by {float(phi[k, i]):.3g} when phase {self.segments[number].name!r} begins "
                f"at t = {float(now[0, i]):.6g} s: a joint that begins to act must be closed",
            )

    def entered_lanes(self, phase_exit: PhaseExit) -> Tensor:
        """Which lanes enter the next phase [lanes]."""
        good = torch.tensor([not reason for reason in self.failures])
        return torch.isfinite(value(phase_exit.t)[0]) & good

    def end_times(self, segment: Segment, t: Any, data: Data) -> Any:
        """Times [1 + n_b, lanes] at which a phase that begins at t ends; None where an event or the simulation ends it."""
        length, until = segment.phase.length, segment.phase.end_time
        number = length if until is None else until
        if number is None:
            return None
        time = data.get(segment.time_name, torch.full_like(value(t), number))
        if until is None:
            return t + time
        for lane in torch.nonzero(torch.isfinite(value(t)[0]) & (value(t)[0] >= until))[:, 0].tolist():
            begins = float(value(t)[0, lane])
            self.failed_for_good.add(lane)
            self.fail(lane, f"phase {segment.name!r} begins at t = {begins:.6g} s, after its end at t = {until:g} s")
        return t * 0.0 + time

    def fail(self, lane: int, reason: str) -> None:
        """Note the first reason why a lane failed."""
        self.failures[lane] = self.failures[lane] or reason

    def doubt(self, lane: int, segment: Segment, t: float) -> None:
        """Note the first time after which the steps of a lane are too long to know whether its phase ends."""
        self.doubts.setdefault(
            lane,
            f"the steps are too long to know whether the event of phase {segment.name!r} occurs in the step from "
            f"t = {t:.6g} s on. Try: more steps",
        )

    def record(self, number: int, first: int, counted: Tensor, states: History, are_kept: bool = False) -> None:
        """Record states, of the dynamics `recorded`, at the point `first` of the grid and those after it.

        counted    which lanes have them [points, lanes];  are_kept: they are in the record already
        """
        at, of_all = slice(first, first + len(counted)), bool(counted.all())
        self.phase_number[at] = torch.where(counted, number, self.phase_number[at])
        if not self.watch.idle:
            whole = replace(states, expansion=self._expansion(self.times[at]))
            q, v = (whole.rows(order, pair=slice(1)) for order in range(2))
            self.watch.update(first, self.times[at], q, v, None if of_all else counted)
        if are_kept:
            return
        kept, begin = slice(-first % self.every, None, self.every), -(-first // self.every)
        states, counted = states.at(kept), counted[kept, None, None]
        for total, x in zip(self.states.parts, states.states, strict=True):
            part = total[begin : begin + len(counted)]
            part.copy_(x if of_all else torch.where(counted, x, part))

    def end(self, segment: Segment, lanes: Sequence[int]) -> None:
        """Note lanes that are in a phase when the simulation ends: an error, unless it is the last."""
        if segment is self.segments[-1]:
            return
        finite = torch.stack([torch.isfinite(x).flatten(1, 2).all(1) for x in (self.q, self.v, self.vd)]).all(0)
        for lane in lanes:
            if not bool(finite[:, lane].all()):
                first = int((~finite[:, lane]).long().argmax())
                self.fail(lane, f"the motion is not finite from t = {float(self.kept_times[first]):.6g} s on")
            else:
                reason = f"it lasts beyond the end of the simulation at t = {self.duration:g} s"
                if segment.phase.lasting is None:
                    reason = f"its event does not occur before the simulation ends at t = {self.duration:g} s"
                self.failed_for_good.add(lane)
                self.fail(lane, f"phase {segment.name!r} never ends: {reason}")


def _least_norm(whole: Dynamics, segment: Segment, dynamics: Dynamics) -> LeastNorm | None:
    """Projection of the multipliers of a phase, among all rows of the whole; None if all are determined."""
    least = dynamics.least_norm
    if least is None:
        return None
    rows = torch.tensor(segment.rows, dtype=torch.long)
    acting = torch.zeros(whole.topology.rows, dtype=torch.float64).index_copy(0, rows, least.acting)
    return LeastNorm(whole.saddle, acting, least.rank)


def _moment(x: State, lam: Any) -> Moment:
    """One side of a switch as the user sees it, lanes first; lam: multipliers of all rows."""
    full = [y.full if isinstance(y, Pair) else y for y in (x.q, x.v, x.vd, lam)]
    tangents = [y[:, 1:].permute(2, 0, 1) if isinstance(x.q, Pair) else None for y in full]
    return Moment(*(y[:, 0].T for y in full), *tangents)
