"""The adjoint of a simulation by a one-step method: gradients of few responses by many design variables.

Tangents cost a share of a simulation for each *variable*; the adjoint of the steps costs about half of one for each
*response*, and as much once for all, however many variables there are. y the derivative of a response by the state
x1 = F(z, x) after a step, z the unknowns of the step, R(z; x, b) = 0 (step.py):

    R_z' mu = F_z' y
    y  <-  F_x' y - R_x' mu  +  what the response takes from the state x itself
    dJ/db  <-  dJ/db - R_b' mu

and last y' dx/db of the state at the start. It is the exact derivative of the discrete map, as the tangents are: both
agree within what their iterations leave. mu comes from the factors of the iteration matrix, transposed and at the solution
itself, with corrections until they are small. b are the numbers of the reduced model: torch differentiates the structure
stage that they come from.

`Adjoint` is kept by the integration (reverse_integration.py); `AdjointSolver` makes the steps by operators of torch,
native/backward.py by compiled code. phases/adjoint.py is the adjoint through phases. Methods of torchdiffeq have none.
Checked in tests/sensitivity/test_adjoint.py, tests/contracts/test_adjoint.py (all joints and forces).
Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, chapter 15 (implicit functions).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.integrate.native.simd_layout import varied_numbers
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.prepared import differentiable, prepare
from torchmbd.integrate.pullback import leaf
from torchmbd.integrate.step import Model, Weights
from torchmbd.integrate.stepper import EagerStepper, resume
from torchmbd.math.pair import value
from torchmbd.math.pull_back import pull_back
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.topology import Schedule
from torchmbd.results.history import History, segments
from torchmbd.results.state import State

# Estimated relative errors of mu. The largest gradient of a response has 100 times that at most, as measured.
INACCURATE = 1e-5  # worth a warning


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


def warn_inaccurate(error: Tensor) -> None:
    """Warn of lanes whose gradients have a large estimated relative error [lanes]."""
    for lane in torch.nonzero(error > INACCURATE)[:, 0].tolist():
        warn(
            f"lane {lane}: the adjoint leaves an error of {float(error[lane]):.1e} of its gradients; more steps help, "
            "or gradients='forward'",
        )


@dataclass
class Grid:
    """Lanes that were integrated with the same equal steps.

    lanes        their numbers in the batch;  history: their states, of the condensed system
    leaves       data of the whole system by which gradients are wanted [component..., 1, lanes]
    dynamics     the equations of the condensed system, and
    start        its initial state: both functions of the leaves in reverse mode
    times        of all steps [steps + 1]
    every        steps between two states that are outputs, from `offset` steps on
    starts       states from which steps are made again, by their number; None: the history has the states of all steps
    cuts         further numbers of states at which segments of steps end
    integrator   that made the steps
    substeps     intervals of kept states for each of the batch
    """

    lanes: list[int]
    history: History
    leaves: dict[str, Tensor]
    dynamics: Dynamics
    start: State
    weights: Weights
    times: Tensor
    integrator: OneStep
    every: int = 1
    offset: int = 0
    starts: dict[int, State] | None = None
    cuts: Sequence[int] = ()
    substeps: int = 1

    def of_kept_states(self, of_motion: Tensor | None, of_steps: Tensor | None) -> Tensor | None:
        """Cotangents [times, n, rows, lanes] of the states of these lanes that are kept, from those of all lanes."""
        coarse, fine = (
            x if x is None or x.shape[-1] == len(self.lanes) else x[..., self.lanes] for x in (of_motion, of_steps)
        )
        return of_kept_states(coarse, fine, len(self.history.q), self.substeps)

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


@dataclass(eq=False)
class Adjoint:
    """The adjoint of one motion.

    dynamics        of the whole system, values only;  dynamics_of_leaves: the same as a function of leaves, or None
    history         what was integrated, by equal steps over the duration [s]
    integrator      that made the steps
    failed          lanes whose cotangents are zero
    adjoint_solver  makes the AdjointSolver of a grid
    """

    dynamics: Dynamics
    history: History
    duration: float
    integrator: OneStep
    failed: Sequence[int]
    adjoint_solver: Callable[[Grid], AdjointSolver]
    dynamics_of_leaves: Dynamics | None = None
    _solvers: dict[tuple[str, ...], list[AdjointSolver]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def error(self) -> Tensor:
        """Estimated relative error of the gradients asked for so far [lanes]."""
        return torch.zeros(self.dynamics.lanes, dtype=torch.float64)

    def __getstate__(self) -> dict[str, Any]:
        """Without the solvers: native ones hold a library, eager ones a graph; both are made again where they are needed."""
        return vars(self) | {"_solvers": {}, "dynamics_of_leaves": None}

    @torch.no_grad()
    def __call__(
        self, of_motion: MotionCotangents, names: Sequence[str], of_steps: MotionCotangents = (None,) * 4
    ) -> dict[str, Tensor]:
        """Cotangents of the data of these names [component..., rows, lanes].

        of_steps   cotangents of the states at the times of the steps of each lane, as of `History.at_steps`
        """
        lanes, rows = self.dynamics.lanes, rows_of([*of_motion, *of_steps])
        shapes = {name: self.dynamics.data[name].shape[:-2] for name in names}
        result = {name: torch.zeros(*shape, rows, lanes, dtype=torch.float64) for name, shape in shapes.items()}
        key = tuple(names)
        if key not in self._solvers:
            self._solvers[key] = [self.adjoint_solver(grid) for grid in self.grids(key)]
        for solver in self._solvers[key]:
            part = solver.grid.lanes
            cotangents, error = solver([solver.grid.of_kept_states(*x) for x in zip(of_motion, of_steps, strict=True)])
            for name, x in solver.grid.cotangents(cotangents).items():
                result[name][..., part] = x
            self.error[part] = self.error[part].maximum(error)
        warn_inaccurate(self.error)
        return result

    def grids(self, names: tuple[str, ...] = ()) -> list[Grid]:
        """Of all lanes that have not failed: of those with the steps asked for, and of each lane with smaller steps."""
        refined = self.history.refined
        lanes = [lane for lane in range(self.dynamics.lanes) if lane not in refined and lane not in self.failed]
        grids = [self._grid(names, lanes, self.history, lanes, 1)] if lanes else []
        for lane, refinement in refined.items():
            if lane not in self.failed:
                grids.append(self._grid(names, [lane], refinement.history, [refinement.lane], refinement.substeps))
        return grids

    def _grid(
        self, names: tuple[str, ...], lanes: list[int], history: History, columns: list[int], substeps: int
    ) -> Grid:
        """Of lanes of the batch, which are `columns` of a history with `substeps` intervals between two outputs."""
        dynamics, of_leaves = self.dynamics, self.dynamics_of_leaves
        leaf_names = () if of_leaves is None else tuple(k for k, x in of_leaves.data.items() if x.requires_grad)
        if of_leaves is None or len(lanes) < of_leaves.lanes or names != leaf_names:
            of_leaves = differentiable(dynamics.select_lanes(lanes) if len(lanes) < dynamics.lanes else dynamics, names)
        leaves = {name: of_leaves.data[name] for name in names}
        _, condensed, start = prepare(of_leaves)
        checkpoints, states = history.checkpoints, history.lanes(columns)
        every = checkpoints.interval if checkpoints else 1
        steps = every * (len(history.q) - 1)
        h = self.duration / steps
        times, weights = h * torch.arange(steps + 1, dtype=torch.float64), self.integrator.weights(h)
        integrator = checkpoints.integrator if checkpoints else self.integrator
        starts = _starts(states, steps) if checkpoints else None
        return Grid(
            lanes, states, leaves, condensed, start, weights, times, integrator, every, starts=starts, substeps=substeps
        )


def _starts(history: History, steps: int) -> dict[int, State]:
    """States from which the steps of a history with checkpoints are made again."""
    result, checkpoints = {}, history.checkpoints
    assert checkpoints is not None
    for part, a in zip(segments(steps, checkpoints.interval), checkpoints.accelerations, strict=True):
        q, v, vd, lam = (x[part.start // checkpoints.interval] for x in history.states)
        result[part.start] = State(q, v, vd, a, lam)
    return result


class AdjointSolver:
    """The adjoint through one grid by operators of torch, one segment of steps after the other, the last one first.

    The memory that it takes besides the history does not grow with the number of steps.
    """

    def __init__(self, grid: Grid):
        self.grid, self.dynamics = grid, grid.dynamics
        T, lanes = self.dynamics.topology, len(grid.lanes)
        self.data = {name: leaf(x.expand(*x.shape[:-2], 1, lanes)) for name, x in self.dynamics.data.items()}
        model = Model(T, self.dynamics.saddle, grid.weights, self.data)
        self.corrections, steps = grid.integrator.counts(self.dynamics)[1], len(grid.times) - 1
        self.stepper = EagerStepper(self.dynamics, model, (1, self.corrections), refresh=1)
        starts = [part.start for part in segments(steps)] if grid.starts is None else grid.starts
        self.segments = [range(i, j) for i, j in itertools.pairwise(sorted({*starts, *grid.cuts, steps}))]
        self.accelerations = self._accelerations() if grid.starts is None else []

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
        by: dict[str, Any] = dict.fromkeys(self.data, 0.0)
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
        stepper, x = grid.integrator.stepper(self.dynamics.values(), float(grid.weights.h)), grid.starts[steps.start]
        return resume(stepper, x, schedule, steps.start)[1], value(x.a)

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
