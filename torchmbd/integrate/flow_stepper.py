"""Steps of a flow of the index-1 equations (ode.py): to outputs, and to times that depend on the design.

All lanes of a motion go through the outputs of a run in one flow; where some have left the phase, or one of them cannot be
integrated (its step size underflows), one by one, and from output to output. So adaptive methods choose their own steps in
every phase. Within a phase the augmented state has derivatives at fixed times; where a time t*(b) moves with the design they
become total,

    dz*/db = dz/db + z' dt*/db        and after the switch again derivatives at fixed times        dz/db = dz*/db - z' dt*/db

Checked in tests/integrate/test_flow_stepper.py, tests/contracts/test_integrators.py, tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.integrator import Stepper
from torchmbd.integrate.lanes import join_states, lane_numbers, lanes_of, pick_lanes
from torchmbd.integrate.ode import RightHandSide, flow
from torchmbd.math.pair import Pair, cat, value
from torchmbd.multibody.equations.times_as_lanes import at_time
from torchmbd.multibody.equations.topology import Schedule
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import Record
from torchmbd.results.state import State

_SAME = 1e-15  # of a time: times that are equal


class FlowStepper(Stepper):
    """Regular steps of size h [s]; `arguments`: of torchdiffeq.odeint, for the dynamics of some lanes."""

    def __init__(self, dynamics: Dynamics, h: float, arguments: Callable[[Dynamics], dict[str, Any]]):
        super().__init__(dynamics)
        self.h, self.arguments = h, arguments
        self._flows: dict[tuple[int, ...], tuple[RightHandSide, dict[str, Any]]] = {}

    def run(self, x: State, schedule: Schedule, record: Record, first: int = 0, start: int = 1) -> State:
        """See Stepper. The schedule counts steps only: the right-hand side evaluates laws itself."""
        self.steps = len(schedule)
        times = self.h * torch.arange(first, first + self.steps + 1, dtype=torch.float64)
        groups = self._groups(times, x)
        for k in range(len(schedule)):
            full = [_full(y).clone() for y in x]
            for lanes, states in groups.items():
                for part, y in zip(full, states[k], strict=True):
                    part[..., lanes] = y
            x = State(*(Pair(y) if isinstance(x.q, Pair) else y for y in full))
            record.put(start + k, x)
        return x

    def _groups(self, times: Tensor, x: State) -> dict[tuple[int, ...], list[list[Tensor]]]:
        """The states at the times after the first, of all lanes that count in one flow, or of each."""
        lanes = tuple(lane_numbers(self.counts))
        if len(lanes) == len(self.counts) > 1 and not self.failed:
            try:
                return {lanes: self._states(lanes, x, times)}
            except FloatingPointError:
                pass  # of one of the lanes: below it is found
        return {(lane,): self._states_of_lane(lane, x, times) for lane in lanes}

    def _states(self, lanes: tuple[int, ...], x: State, times: Tensor) -> list[list[Tensor]]:
        """The states of lanes at the times after the first, in one flow; raises FloatingPointError."""
        y = torch.cat([_full(pick_lanes(part, lanes)) for part in (x.q, x.v)])
        return self._of_augmented(lanes, [*self._flow(lanes, y, times)[1:]], times)

    def _of_augmented(self, lanes: tuple[int, ...], states: Sequence[Tensor], times: Tensor) -> list[list[Tensor]]:
        """Parts of states, from augmented ones at the times after the first."""
        T, result = self.dynamics.topology, []
        for t, y in zip(times[1:], states, strict=False):
            a, lam = self._flow_of(lanes)[0].accelerations(t, y)
            result.append([*y.split([T.n_q, T.n_v]), a, a, lam])
        return result

    def _flow(self, lanes: tuple[int, ...], y: Tensor, times: Tensor) -> Tensor:
        """Augmented states of lanes at the times, from y at the first."""
        f, arguments = self._flow_of(lanes)
        return flow(f, y, times, arguments)

    def _flow_of(self, lanes: tuple[int, ...]) -> tuple[RightHandSide, dict[str, Any]]:
        if lanes not in self._flows:
            dynamics = lanes_of(self.dynamics, lanes)
            self._flows[lanes] = backend_of(dynamics).right_hand_side(dynamics), self.arguments(dynamics)
        return self._flows[lanes]

    def _states_of_lane(self, lane: int, x: State, times: Tensor) -> list[list[Tensor]]:
        """The same of one lane, whether it can be integrated or not."""
        state = [_full(pick_lanes(y, [lane])) for y in x]
        if lane in self.failed:
            return [state] * self.steps
        try:
            return self._states((lane,), x, times)
        except FloatingPointError:
            states = self._from_output_to_output(lane, torch.cat(state[:2]), times)
        result = self._of_augmented((lane,), states, times)
        return result + [[y * torch.nan for y in state]] * (self.steps - len(result))

    def _from_output_to_output(self, lane: int, y: Tensor, times: Tensor) -> list[Tensor]:
        """Augmented states of one lane at the times after the first, up to where it cannot be integrated."""
        states: list[Tensor] = []
        for k in range(self.steps):
            try:
                y = self._flow((lane,), y, times[k : k + 2])[-1]
            except FloatingPointError as error:
                self.failed[lane] = str(error)
                break
            states.append(y)
        return states

    def algorithmic(self, a: Any, vd: Tensor) -> Any:
        """See Stepper. It is the true acceleration here."""
        return Pair(vd[-1]) if vd.shape[-2] > 1 else vd[-1]


def flow_of_size(dynamics: Dynamics, x: State, h: Any, t1: Any, arguments: dict[str, Any]) -> State:
    """The states of all lanes times h later, at t1; as in `Integrator.step_of_size`."""
    parts = []
    for lane in range(x.q.shape[-1]):
        size, end = (pick_lanes(y, [lane]) for y in (h, t1))
        state = x.map(lambda y, lane=lane: pick_lanes(y, [lane]))
        parts.append(_flow_of_lane(lanes_of(dynamics, [lane]), state, size, end, arguments))
    return join_states(parts)


def _flow_of_lane(dynamics: Dynamics, x: State, h: Any, t1: Any, arguments: dict[str, Any]) -> State:
    """The state of one lane time h later, at t1; nan where it cannot be integrated."""
    t0 = t1 - h
    y = _shifted(dynamics, _full(cat([x.q, x.v])), t0, -1.0)
    now, then = float(value(t0)), float(value(t1))
    if abs(then - now) > _SAME * abs(then):
        times = torch.tensor([now, then], dtype=torch.float64)
        try:
            y = flow(backend_of(dynamics).right_hand_side(dynamics), y, times, arguments)[-1]
        except FloatingPointError:
            return x.map(lambda z: z * torch.nan)
    y = _shifted(dynamics, y, t1, 1.0)
    z = Pair(y) if y.shape[1] > 1 else y
    q, v = z[: dynamics.topology.n_q], z[dynamics.topology.n_q :]
    a, lam = at_time(Dynamics.accelerations, dynamics, t1, q, v)
    return State(q, v, a, a, lam)


def _shifted(dynamics: Dynamics, y: Tensor, t: Any, sign: float) -> Tensor:
    """y [n_z, 1 + n_b, 1] with what a time that moves with the design adds to its derivatives, or without it."""
    if not isinstance(t, Pair) or not bool(t.tangent.any()):
        return y
    rate = dynamics.values().rates(torch.tensor(float(value(t)), dtype=torch.float64), y[:, :1])
    return torch.cat([y[:, :1], y[:, 1:] + sign * rate * t.tangent], 1)


def _full(x: Any) -> Tensor:
    return x.full if isinstance(x, Pair) else x
