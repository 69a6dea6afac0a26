"""The pullback of a motion through phases: each run by its adjoint, and mode shapes through the structure stage.

Lanes that were integrated again are those of another run, by other steps (retries.py).
Checked in tests/sensitivity/test_phase_adjoint.py, tests/integrate/phases/test_retries.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.adjoint_solver import of_kept_states
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.outputs import STATES, Outputs
from torchmbd.integrate.phases.adjoint import PhaseAdjoint
from torchmbd.integrate.phases.lane_leaves import Key, pulled_back
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.retries import LaneResults
from torchmbd.results.mode_shapes import DesignShapes
from torchmbd.results.motion_data import has_failed


class _Lanes(NamedTuple):
    """Lanes of a batch that one run integrated.

    lanes      their numbers in the batch;  sources: and in the run
    substeps   steps of the run for each of the batch
    """

    run: MultiphaseRun
    lanes: list[int]
    sources: list[int]
    substeps: int

    def of_batch(self, x: Tensor | None) -> Tensor | None:
        """Cotangents [..., lanes] of the lanes of the run, zero where a lane of the batch is not one of it."""
        if x is None or self.lanes == self.sources == list(range(self.run.whole.lanes)) == list(range(x.shape[-1])):
            return x
        result = x.new_zeros(*x.shape[:-1], self.run.whole.lanes)
        result[..., self.sources] = x[..., self.lanes] if x.shape[-1] > 1 else x
        return result

    def of_outputs(self, bar: Outputs) -> Outputs:
        """Cotangents of the states at the steps of the run, its data and its switches, from those of the batch."""
        pairs = zip(bar.states, list(bar.at_steps[:STATES]) or [None] * STATES, strict=True)
        states = [(self.of_batch(at_times), self.of_batch(at_steps)) for at_times, at_steps in pairs]
        return bar._replace(
            states=[of_kept_states(*x, len(self.run.q), self.substeps) for x in states],
            data={name: self.of_batch(x) for name, x in bar.data.items()},
            switches=[[self.of_batch(x) for x in numbers] for numbers in bar.switches],
        )


@dataclass(eq=False)
class MotionPullback:
    """The pullback of the motion of a problem by a one-step method."""

    problem: InitialValueProblem
    results: LaneResults

    def __call__(self, bar: Outputs, rows: int, names: Sequence[str], by_designs: bool) -> dict[str, Tensor]:
        """By data of these names, and by designs where wanted: [component..., rows, lanes]; of lanes that failed zero."""
        lanes: list[int] = []
        parts: list[dict[Key, Tensor]] = []
        for part in self._parts():
            absent = [lane for lane in range(part.run.whole.lanes) if lane not in part.sources]
            sources, cotangents = PhaseAdjoint(part.run, names, absent)(part.of_outputs(bar), rows)
            to_batch = dict(zip(part.sources, part.lanes, strict=True))
            lanes += [to_batch[source] for source in sources]
            parts.append(cotangents)
        of_lanes, result = _joined(parts), {}
        for name in names:
            x = self.problem.dynamics.data[name]
            result[name] = x.new_zeros(*x.shape[:-2], rows, len(self.results.status))
            if ("data", name) in of_lanes:
                result[name][..., lanes] = of_lanes["data", name][..., 0, :].movedim(0, -2)
        return result | (self._of_designs(lanes, of_lanes, rows) if by_designs else {})

    def _parts(self) -> list[_Lanes]:
        """Lanes that have not failed, by their runs."""
        history, parts = self.results.history, {}
        for lane, status in enumerate(self.results.status):
            if has_failed(status):
                continue
            refined = history.refined.get(lane)
            run, source, substeps = (history.run, lane, 1) if refined is None else (refined.history.run, *refined[1:])
            part = parts.setdefault(id(run), _Lanes(run, [], [], substeps))
            part.lanes.append(lane)
            part.sources.append(source)
        return list(parts.values())

    def _of_designs(self, lanes: list[int], by: dict[Key, Tensor], rows: int) -> dict[str, Tensor]:
        """Their own, and those of the mode shapes through the structure stage."""
        whole, count = self.problem.views.whole, len(self.results.status)
        kinds = {key for key in by if key[0] != "data"}
        with torch.enable_grad():
            designs = {name: x.detach().clone().requires_grad_() for name, x in whole.designs.items()}
            shapes = DesignShapes(whole.system, designs, count)
            outputs = {(k, n): designs[n] if k == "design" else shapes.values(n) for k, n in kinds}
        cotangents = {key: x.new_zeros(rows, *x.shape) for key, x in outputs.items()}
        for key, x in cotangents.items():
            x[:, lanes] += by[key]
        by_designs = pulled_back(list(outputs.values()), list(cotangents.values()), list(designs.values()), rows)
        return {name: x.movedim((0, 1), (-2, -1)) for name, x in zip(designs, by_designs, strict=True)}


def _joined(parts: Sequence[dict[Key, Tensor]]) -> dict[Key, Tensor]:
    """Cotangents [rows, component..., lanes] of data, [rows, lanes, ...] of the rest, of the lanes of all parts."""
    if len(parts) == 1:
        return parts[0]
    result = {}
    for key in {key: None for part in parts for key in part}:
        axis = -1 if key[0] == "data" else 1
        result[key] = torch.cat([part[key] for part in parts], axis)
    return result
