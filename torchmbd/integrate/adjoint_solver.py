"""The adjoint through equal steps: from cotangents of their states to those of what they depend on; see adjoint.py.

Checked in tests/sensitivity/test_adjoint.py, tests/contracts/test_adjoint.py (all joints and forces).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.lanes import expanded
from torchmbd.integrate.pullback import leaf
from torchmbd.integrate.step import Model, Weights, algorithmic
from torchmbd.integrate.stepper import EagerStepper, resume
from torchmbd.math.pair import Pair, value
from torchmbd.math.pull_back import pull_back
from torchmbd.multibody.equations.topology import Schedule, Topology
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History, segments
from torchmbd.results.state import State

# Cotangents of q, v, a, lam, in this order [times, n, rows, lanes]; None: zero.
MotionCotangents = Sequence[Tensor | None]


def rows_of(of_motion: MotionCotangents) -> int:
    """Number of responses."""
    return next((x.shape[2] for x in of_motion if x is not None), 0)


def of_kept_states(coarse: Tensor | None, fine: Tensor | None, count: int, substeps: int) -> Tensor | None:
    """Cotangents [count, n, rows, lanes] of the states that are kept, from those of every `substeps`-th and those of all."""
    if coarse is None:
        return None if fine is None else fine[:count]
    if fine is None and substeps == 1:
        return coarse
    result = coarse.new_zeros(count, *coarse.shape[1:]) if fine is None else fine[:count].clone()
    result[::substeps] += coarse
    return result


@dataclass
class Grid:
    """Lanes that were integrated with the same equal steps.

    lanes        their numbers in the batch;  history: their states, of the condensed system
    leaves       data of the whole system by which gradients are wanted [component..., 1, lanes]
    dynamics     the equations of the condensed system, and
    start        its initial state: both functions of the leaves in reverse mode
    times        of all steps [steps + 1]
    every        steps between two states that are outputs, from `offset` steps on
    first        the point of the grid of the motion at which they begin
    starts       states from which steps are made again, by their number; None: the history has the states of all steps
    restarts     numbers of further states at which the stepper discarded what it keeps
    cuts         further numbers of states at which segments of steps end
    integrator   that made the steps;  corrections: of their cotangents, at least
    """

    lanes: list[int]
    history: History
    leaves: dict[str, Tensor]
    dynamics: Dynamics
    start: State
    weights: Weights
    times: Tensor
    integrator: Integrator
    corrections: int
    every: int = 1
    offset: int = 0
    first: int = 0
    starts: dict[int, State] | None = None
    restarts: Sequence[int] = ()
    cuts: Sequence[int] = ()

    def cotangents(self, by: Cotangents) -> dict[str, Tensor]:
        """By the leaves [component..., rows, lanes]: through the start, the laws of drives and the condensation."""
        outputs, of_motion = [*self.start], [*by.start]
        for name, x in by.data.items():
            outputs.append(self.dynamics.data[name])
            of_motion.append(x)
        if by.laws is not None:
            with torch.enable_grad():
                T = self.dynamics.topology
                outputs.append(varied_numbers(T, T.schedule(self.times[1:], self.dynamics.data), len(self.lanes), 0))
            of_motion.append(by.laws)
        used = [(y, x) for y, x in zip(outputs, of_motion, strict=True) if y.requires_grad]
        leaves = list(self.leaves.values())
        if not used:
            return {}
        rows = [x if x.shape[-1] == y.shape[-1] else x.sum(-1, keepdim=True) for y, x in used]
        cotangents = pull_back([y for y, _ in used], leaves, [x.movedim(-2, 0).unsqueeze(-2) for x in rows])
        return {name: x.squeeze(-2).movedim(0, -2) for name, x in zip(self.leaves, cotangents, strict=True)}


class Cotangents(NamedTuple):
    """Cotangents that the steps give.

    data    by name [component..., rows, lanes]
    laws    of what laws with design variables prescribe [steps, n, rows, lanes]; None: there are none
    start   of the initial state [n, rows, lanes]
    """

    data: dict[str, Tensor]
    laws: Tensor | None
    start: State


def varied_numbers(T: Topology, schedule: Schedule, lanes: int, n_b: int) -> Tensor:
    """What laws with design variables prescribe [times, n, 1 + n_b, lanes]."""
    if not T.varying_primitives:
        return schedule.A.new_zeros(len(schedule), 0, 1 + n_b, lanes)
    parts = [x.full if isinstance(x, Pair) else x for i in T.varying_primitives for x in schedule.laws[i] or ()]
    wide = [torch.nn.functional.pad(x, (0, 0, 0, 1 + n_b - x.shape[-2])) for x in parts]
    return torch.cat([expanded(x, lanes) for x in wide], 1)


class AdjointSolver:
    """The adjoint through one grid by operators of torch, one segment of steps after the other, the last one first.

    The memory that it takes besides the history does not grow with the number of steps.
    """

    def __init__(self, grid: Grid):
        self.grid, self.dynamics = grid, grid.dynamics
        self.corrections, steps = grid.corrections, len(grid.times) - 1
        starts = [part.start for part in segments(steps)] if grid.starts is None else grid.starts
        self.segments = [range(i, j) for i, j in itertools.pairwise(sorted({*starts, *grid.cuts, steps}))]
        self.accelerations = self._accelerations() if grid.starts is None else []

    @cached_property
    def stepper(self) -> EagerStepper:
        """Its model's data are leaves of the pullbacks of steps."""
        dynamics, lanes = self.dynamics, len(self.grid.lanes)
        data = {name: leaf(x.expand(*x.shape[:-2], 1, lanes)) for name, x in dynamics.data.items()}
        model = Model(dynamics.topology, dynamics.saddle, self.grid.weights, data, dynamics.sizes.unknowns)
        return EagerStepper(dynamics, model, (1, self.corrections), refresh=1)

    def __call__(
        self, of_motion: MotionCotangents, of_states: Mapping[int, State] = MappingProxyType({})
    ) -> tuple[Cotangents, Tensor]:
        """Cotangents of the steps, from those of the outputs, and their estimated relative error [lanes].

        of_states   of states at ends of segments, by their number, as well: with algorithmic accelerations
        """
        y, by, laws = self._of_outputs(of_motion, len(self.grid.times) - 1), {}, []
        error = torch.zeros(len(self.grid.lanes), dtype=torch.float64)
        for number in reversed(range(len(self.segments))):
            more = of_states.get(self.segments[number].stop)
            y = y if more is None else State(*(a + b for a, b in zip(y, more, strict=True)))
            part, part_error = self._segment(number, of_motion, y)
            by = {name: x + by.get(name, 0.0) for name, x in part.data.items()}
            laws.append(part.laws)
            y, error = part.start, error.maximum(part_error)
        varied = self.dynamics.topology.varying_primitives
        return Cotangents(by, torch.cat(laws[::-1]) if varied else None, y), error

    def _segment(self, number: int, of_motion: MotionCotangents, y: State) -> tuple[Cotangents, Tensor]:
        """Cotangents through one segment, from those y of its last state; `start` are those of its first state."""
        steps, lanes = self.segments[number], len(self.grid.lanes)
        T = self.dynamics.topology
        schedule = self._schedule(steps)
        states = self._states(self._history(number, schedule))
        by: dict[str, Any] = dict.fromkeys(self.dynamics.data, 0.0)
        laws, error = [], torch.zeros(lanes, dtype=torch.float64)
        for i in reversed(range(len(steps))):
            cotangents = self.stepper.pullback(states[i], states[i + 1], schedule[i], y)
            y = State(*(a + b for a, b in zip(cotangents.state, self._of_outputs(of_motion, steps[i]), strict=True)))
            by = {name: x + cotangents.data[name] for name, x in by.items()}
            laws.append(torch.cat(list(cotangents.laws.values())) if cotangents.laws else None)
            error = error.maximum(cotangents.error)
        return Cotangents(by, torch.stack(laws[::-1]) if T.varying_primitives else None, y), error

    def _schedule(self, steps: range) -> Schedule:
        """Drives and bodies of known motion at the ends of steps."""
        return self.dynamics.topology.schedule(self.grid.times[steps.start + 1 : steps.stop + 1], self.dynamics.data)

    def _accelerations(self) -> list[Tensor]:
        """The algorithmic acceleration [n_v, 1, lanes] at the first state of each segment, where it is not recorded.

        a1 = w(v0', v1') + c a0 over a segment is a sum with powers of c.
        """
        w, vd = self.grid.weights, self.grid.history.vd
        a = value(self.grid.start.a).expand(*vd.shape[1:])
        accelerations = [a]
        for steps in self.segments[:-1]:
            some = vd[steps.start : steps.stop + 1]
            powers = w.a_from_a ** torch.arange(len(steps), dtype=torch.float64).flip(0)
            new = torch.einsum("t,tnsl->nsl", powers, w.a_from_vd * some[:-1] + w.share * some[1:])
            accelerations.append(new + w.a_from_a ** len(steps) * accelerations[-1])
        return accelerations

    def _history(self, number: int, schedule: Schedule) -> tuple[History, Tensor]:
        """States at all times of a segment, recorded or made again, and the first algorithmic acceleration."""
        grid, steps = self.grid, self.segments[number]
        if grid.starts is None:
            return grid.history.at(slice(steps.start, steps.stop + 1)), self.accelerations[number]
        begin = max(k for k in grid.starts if k <= steps.start)
        stepper, x = grid.integrator.stepper(self.dynamics.values(), float(grid.weights.h)), grid.starts[begin]
        schedule = schedule if begin == steps.start else self._schedule(range(begin, steps.stop))
        restarts = (grid.first + k for k in grid.restarts)
        history, before = resume(stepper, x, schedule, grid.first + begin, restarts)[1], steps.start - begin
        a = value(algorithmic(grid.weights, x.a, history.vd[: before + 1])) if before else value(x.a)
        return history.at(slice(before, None)), a

    def _states(self, known: tuple[History, Tensor]) -> list[State]:
        """States [n, 1, lanes] of a history at all its times."""
        (h, a), w, states = known, self.grid.weights, []
        for i in range(len(h.q)):
            a = w.a_from_vd * h.vd[i - 1] + w.a_from_a * a + w.share * h.vd[i] if states else a
            states.append(State(h.q[i], h.v[i], h.vd[i], a, h.lam[i]))
        return states

    def _of_outputs(self, of_motion: MotionCotangents, i: int) -> State:
        """Cotangents of the state after i steps, as an output of the motion."""
        h, rows, (row, beside) = self.grid.history, rows_of(of_motion), divmod(i - self.grid.offset, self.grid.every)
        both = zip(of_motion, (h.q, h.v, h.vd, h.lam), strict=True)
        parts = [y.new_zeros(y.shape[1], rows, y.shape[-1]) if x is None or beside else x[row] for x, y in both]
        q, v, vd, lam = parts
        return State(q, v, vd, torch.zeros_like(vd), lam)
