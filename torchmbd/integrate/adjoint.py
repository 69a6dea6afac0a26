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

Lanes of one run go back together (`RunAdjoint`, phases/adjoint.py), from its last segment to its first: a motion without phases
has one. Lanes that were integrated again are those of another run, by other steps (retries.py). Mode shapes, which events and
impacts read, go back through the structure stage.
`Adjoint` is kept by the integration (reverse_integration.py); the steps are those of an `AdjointSolver` (adjoint_solver.py), or
of another backend. Methods of torchdiffeq have none.
Checked in tests/sensitivity/test_adjoint.py, tests/sensitivity/test_phase_adjoint.py, tests/integrate/phases/test_retries.py,
tests/contracts/test_adjoint.py (all joints and forces).
Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., SIAM 2008, chapter 15 (implicit functions).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.integrate.adjoint_solver import of_kept_states
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.outputs import STATES, Outputs
from torchmbd.integrate.phases.adjoint import RunAdjoint
from torchmbd.integrate.phases.lane_leaves import Key, add_lanes, pulled_back
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.retries import LaneResults
from torchmbd.results.mode_shapes import DesignShapes
from torchmbd.results.motion_data import has_failed

# Estimated relative errors of mu. The largest gradient of a response has 100 times that at most, as measured.
INACCURATE = 1e-5  # worth a warning


class LanesOfRun(NamedTuple):
    """Lanes of a batch that one run integrated.

    adjoint    of the run, of these lanes;  lanes: their numbers in the batch
    substeps   steps of the run for each of the batch
    """

    adjoint: RunAdjoint
    lanes: list[int]
    substeps: int

    def of_run(self, x: Tensor | None) -> Tensor | None:
        """Cotangents [..., lanes] of the lanes of the run, zero where a lane of the batch is not one of it."""
        if x is None:
            return None
        sources, count = self.adjoint.lanes, len(self.adjoint.error)
        if self.lanes == sources == list(range(count)) == list(range(x.shape[-1])):
            return x
        result = x.new_zeros(*x.shape[:-1], count)
        result[..., sources] = x[..., self.lanes] if x.shape[-1] > 1 else x
        return result

    def of_outputs(self, bar: Outputs) -> Outputs:
        """Cotangents of the states at the steps of the run, its data and its switches, from those of the batch."""
        of_steps, count = bar.at_steps[:STATES] or (None,) * STATES, len(self.adjoint.run.q)
        states = [(self.of_run(x), self.of_run(y)) for x, y in zip(bar.states, of_steps, strict=True)]
        return bar._replace(
            states=[of_kept_states(*x, count, self.substeps) for x in states],
            data={name: self.of_run(x) for name, x in bar.data.items()},
            switches=[[self.of_run(x) for x in numbers] for numbers in bar.switches],
        )


@dataclass(eq=False)
class Adjoint:
    """The adjoint of the motion of a problem by a one-step method: zero of lanes that have failed."""

    problem: InitialValueProblem
    results: LaneResults
    _runs: dict[tuple[str, ...], list[LanesOfRun]] = field(default_factory=dict, init=False, repr=False)

    @property
    def error(self) -> Tensor:
        """Estimated relative error of the gradients asked for so far [lanes]."""
        result = torch.zeros(len(self.results.status), dtype=torch.float64)
        for run in chain(*self._runs.values()):
            result[run.lanes] = result[run.lanes].maximum(run.adjoint.error[run.adjoint.lanes])
        return result

    def __getstate__(self) -> dict[str, Any]:
        """Without what holds a graph, or a library of a backend; it is made again where it is needed."""
        return vars(self) | {"_runs": {}}

    def __call__(
        self, bar: Outputs, rows: int, names: Sequence[str], by_designs: bool
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Cotangents by data of these names, and by designs where wanted [component..., rows, lanes].

        They are apart because `gravity` is the name of both.
        """
        parts = [(run.lanes, run.adjoint(run.of_outputs(bar), rows)) for run in self.runs(tuple(names))]
        _warn_inaccurate(self.error)
        total, count = {}, len(self.results.status)
        for key in {key: None for _, part in parts for key in part}:
            total[key] = _joined([(lanes, part[key]) for lanes, part in parts if key in part], key, count)
        result = {}
        for name in names:
            x = self.problem.dynamics.data[name]
            of_data = total.get(("data", name))
            zero = of_data is None
            result[name] = x.new_zeros(*x.shape[:-2], rows, count) if zero else of_data[..., 0, :].movedim(0, -2)
        return result, self._of_designs(total, rows) if by_designs else {}

    def runs(self, names: tuple[str, ...]) -> list[LanesOfRun]:
        """Lanes that have not failed, by their runs; gradients are wanted by data of these names."""
        if names not in self._runs:
            history, groups = self.results.history, {}
            for lane, status in enumerate(self.results.status):
                if not has_failed(status):
                    refined = history.refined.get(lane)
                    source = (history.run, lane, 1) if refined is None else (refined.history.run, *refined[1:])
                    groups.setdefault(id(source[0]), []).append((lane, source))
            self._runs[names] = [_lanes_of_run(names, group) for group in groups.values()]
        return self._runs[names]

    def _of_designs(self, by: dict[Key, Tensor], rows: int) -> dict[str, Tensor]:
        """Their own, and those of the mode shapes through the structure stage."""
        whole, count = self.problem.views.whole, len(self.results.status)
        keys = [key for key in by if key[0] != "data"]
        with torch.enable_grad():
            designs = {name: x.detach().clone().requires_grad_() for name, x in whole.designs.items()}
            shapes = DesignShapes(whole.system, designs, count)
            outputs = [designs[name] if kind == "design" else shapes.values(name) for kind, name in keys]
        by_designs = pulled_back(outputs, [by[key] for key in keys], list(designs.values()), rows)
        return {name: x.movedim((0, 1), (-2, -1)) for name, x in zip(designs, by_designs, strict=True)}


def _warn_inaccurate(error: Tensor) -> None:
    """Warn of lanes whose gradients have a large estimated relative error [lanes]."""
    for lane in torch.nonzero(error > INACCURATE)[:, 0].tolist():
        warn(
            f"lane {lane}: gradients of the adjoint have a relative error of {float(error[lane]):.1e}. Try: more steps, "
            "or gradients='forward'",
        )


def _lanes_of_run(names: Sequence[str], group: Sequence[tuple[int, tuple[MultiphaseRun, int, int]]]) -> LanesOfRun:
    """Return the adjoint of the lanes that one run integrated.

    group   lanes of the batch; of each the run, its number in the run, and the steps of the run for one of the batch
    """
    lanes, sources = zip(*group, strict=True)
    run, _, substeps = sources[0]
    return LanesOfRun(RunAdjoint(run, names, [lane for _, lane, _ in sources]), list(lanes), substeps)


def _joined(parts: Sequence[tuple[list[int], Tensor]], key: Key, count: int) -> Tensor:
    """Cotangents of a leaf of all lanes of the batch from those of some: [rows, component..., lanes] of data, else
    [rows, lanes, ...]."""
    lanes, first = parts[0]
    if lanes == list(range(count)):
        return first
    shape = list(first.shape)
    shape[-1 if key[0] == "data" else 1] = count
    total = first.new_zeros(shape)
    for lanes, part in parts:
        add_lanes(total, key[0], lanes, part)
    return total
