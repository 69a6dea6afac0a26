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

`Adjoint` is kept by the integration (reverse_integration.py); the steps are those of an `AdjointSolver` (adjoint_solver.py), or
of another backend. phases/adjoint.py is the adjoint through phases. Methods of torchdiffeq have none.
Checked in tests/sensitivity/test_adjoint.py, tests/contracts/test_adjoint.py (all joints and forces).
Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, chapter 15 (implicit functions).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.integrate.adjoint_solver import AdjointSolver, Grid, MotionCotangents, rows_of
from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.prepared import differentiable, prepare
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History, segments
from torchmbd.results.state import State

# Estimated relative errors of mu. The largest gradient of a response has 100 times that at most, as measured.
INACCURATE = 1e-5  # worth a warning


def warn_inaccurate(error: Tensor) -> None:
    """Warn of lanes whose gradients have a large estimated relative error [lanes]."""
    for lane in torch.nonzero(error > INACCURATE)[:, 0].tolist():
        warn(
            f"lane {lane}: the adjoint leaves an error of {float(error[lane]):.1e} of its gradients; more steps help, "
            "or gradients='forward'",
        )


@dataclass(eq=False)
class Adjoint:
    """The adjoint of one motion.

    dynamics        of the whole system, values only;  dynamics_of_leaves: the same as a function of leaves, or None
    history         what was integrated, by equal steps over the duration [s]
    integrator      that made the steps
    failed          lanes whose cotangents are zero
    """

    dynamics: Dynamics
    history: History
    duration: float
    integrator: OneStep
    failed: Sequence[int]
    dynamics_of_leaves: Dynamics | None = None
    _solvers: dict[tuple[str, ...], list[AdjointSolver]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def error(self) -> Tensor:
        """Estimated relative error of the gradients asked for so far [lanes]."""
        return torch.zeros(self.dynamics.lanes, dtype=torch.float64)

    def __getstate__(self) -> dict[str, Any]:
        """Without the solvers, which hold a graph, or a library of a backend; they are made again where they are needed."""
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
            self._solvers[key] = [backend_of(self.dynamics).adjoint_solver(grid) for grid in self.grids(key)]
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
        _, condensed, start, _ = prepare(of_leaves)
        checkpoints, states = history.checkpoints, history.lanes(columns)
        every = checkpoints.interval if checkpoints else 1
        steps = every * (len(history.q) - 1)
        times = torch.linspace(0.0, self.duration, steps + 1, dtype=torch.float64)
        return Grid(
            lanes=lanes,
            history=states,
            leaves=leaves,
            dynamics=condensed,
            start=start,
            weights=self.integrator.weights(self.duration / steps),
            times=times,
            integrator=checkpoints.integrator if checkpoints else self.integrator,
            corrections=self.integrator.counts(condensed)[1],
            every=every,
            starts=_starts(states, steps) if checkpoints else None,
            substeps=substeps,
        )


def _starts(history: History, steps: int) -> dict[int, State]:
    """States from which the steps of a history with checkpoints are made again."""
    result, checkpoints = {}, history.checkpoints
    assert checkpoints is not None
    for part, a in zip(segments(steps, checkpoints.interval), checkpoints.accelerations, strict=True):
        q, v, vd, lam = (x[part.start // checkpoints.interval] for x in history.states)
        result[part.start] = State(q, v, vd, a, lam)
    return result
