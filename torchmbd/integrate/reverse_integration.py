"""A motion by a one-step method whose reverse mode is the discrete adjoint; see motion.py and adjoint.py.

    inputs    the data of the reduced model, in the order of `names`; where events end segments also designs
              [component..., 1, lanes]: events and impact maps may depend on these, and on the mode shapes that follow from them
    outputs   outputs.py; where all segments have the equations of the whole, states are those of the condensed system

Tangents are integrated when they are asked for, together with the values once more, by the steps that gave these. Those by the
duration are made by operators of torch (`MovingSteps`).
Checked in tests/integrate/test_motion.py, tests/sensitivity/test_adjoint.py, tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.adjoint import Adjoint
from torchmbd.integrate.backend import with_backend
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrated_motion import IntegratedMotion
from torchmbd.integrate.motion import Tensors
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.outputs import Outputs
from torchmbd.integrate.phases.adjoint import MARKED
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.segment import DURATION, Segment, keep_equations
from torchmbd.integrate.prepared import with_leaves
from torchmbd.integrate.retries import LaneResults, integrate_again
from torchmbd.math.pair import Pair, linear
from torchmbd.multibody.system import Dynamics


@dataclass(eq=False, kw_only=True)
class ReverseIntegration(IntegratedMotion):
    """By equal steps that have a pullback, and by steps of other sizes at switches.

    names            of the data;  designs: of the designs
    model            topology and options of its equations; its data are not used
    differentiated   names of data that are, as far as known before the integration: the initial state is then made once
    """

    integrator: OneStep  # pyright: ignore[reportIncompatibleVariableOverride]
    segments: list[Segment]
    model: Dynamics
    designs: tuple[str, ...]
    differentiated: tuple[str, ...] = ()
    variables: tuple[str, ...] = ()  # none carries tangents along

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        data = dict(zip(self.names, inputs, strict=False))
        if DURATION in data and data[DURATION].shape[-1] > 1:
            raise InputError("duration", allowed="one duration for all designs", state="is a batch of torch.vmap")
        moves = zip(self.designs, inputs[len(self.names) :], strict=True)
        designs = {name: x.squeeze(-2).movedim(-1, 0) for name, x in moves}
        keeps = keep_equations(self.segments, self.model.topology)
        work = (*self.integrator.work, "adjoint") if keeps else ()
        dynamics = with_backend(replace(self.model, data=data), self.backend, work)
        lanes = dynamics.lanes  # of torch.vmap; what has no part in it has one
        designs = {name: x.expand(lanes, *x.shape[1:]) for name, x in designs.items()}
        self.problem = self._problem_of(dynamics, designs)
        of_leaves = with_leaves(dynamics, self.differentiated)
        self.integrate(replace(self.problem, dynamics=of_leaves), 0)
        if self.results.data is None:
            self.dynamics = dynamics  # without the leaves
        if keeps:
            self.dynamics.share_rank(of_leaves).evaluate_rank()
        self.outputs = self._outputs(self.results)
        return self.outputs.values()

    def tangents(self, directions: Tensors) -> list[Tensor]:
        along = dict(zip(self.names, directions, strict=False))
        moves = zip(self.designs, directions[len(self.names) :], strict=True)
        designs = {name: dx.movedim((-2, -1), (0, 1)) for name, dx in moves if dx is not None}
        data = {name: dx for name, dx in along.items() if dx is not None and name != DURATION}
        parts = [self._integrated(data, designs)] if data or designs else []
        by_duration = along.get(DURATION)
        if by_duration is not None:
            parts.append([x * by_duration for x in self._by_duration])
        total = parts[0] if len(parts) == 1 else [x + y for x, y in zip(*parts, strict=True)]
        return [self.of_sound_lanes(x) for x in total]

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        differentiated = [name for name, needed in zip(self.names, needs_grad, strict=False) if needed]
        names, by_designs = [name for name in differentiated if name != DURATION], any(needs_grad[len(self.names) :])
        by_name: dict[str, Tensor] = {}
        of_designs: dict[str, Tensor] = {}
        if names or by_designs:
            rows = next(x.shape[-2] for x in outputs if x is not None)
            by_name, of_designs = self.adjoint(self.outputs.like(outputs), rows, names, by_designs)
        if DURATION in differentiated:
            pairs = [(y, dx) for y, dx in zip(outputs, self._by_duration, strict=True) if y is not None]
            # No number is asked of a motion without one.
            products = [torch.where(y != 0.0, y * dx, 0.0) for y, dx in pairs]
            by_name[DURATION] = torch.stack([x.flatten(0, -3).sum(0) for x in products]).sum(0)
        return [*(by_name.get(name) for name in self.names), *(of_designs.get(name) for name in self.designs)]

    @cached_property
    def _by_duration(self) -> list[Tensor]:
        """Tangents of all outputs by the duration, by operators of torch."""
        self.stats["gradient by the duration"] = "eager"
        tangents = self._integrated({DURATION: torch.ones(1, 1, dtype=torch.float64)}, {})
        return [self.of_sound_lanes(x) for x in tangents]

    @cached_property
    def adjoint(self) -> Adjoint:
        """Kept: initial state and steps are prepared once for all pullbacks."""
        return Adjoint(self.problem, self.results)

    def _problem_of(
        self, dynamics: Dynamics, designs: dict[str, Tensor], along: dict[str, Tensor] | None = None
    ) -> InitialValueProblem:
        """along: tangents of the designs [k, lanes, ...]."""
        views = Views.of(self.system, dynamics, designs, along)
        return InitialValueProblem(dynamics, self.segments, views, self.duration)

    def _integrated(self, data: Mapping[str, Tensor], designs: Mapping[str, Tensor]) -> list[Tensor]:
        """Tangents of all outputs along directions of the data [component..., k, lanes] and the designs [k, lanes, ...]."""
        count = next((x.shape[-2] for x in data.values()), 0) or next(len(x) for x in designs.values())
        values, base_designs = self.problem.dynamics, self.problem.views.whole.designs
        moving = {name: Pair.of(values.data[name].detach(), dx) for name, dx in data.items()}
        along = {name: dx.expand(len(dx), len(base_designs[name]), *dx.shape[2:]) for name, dx in designs.items()}
        dynamics = replace(values, data={name: x.detach() for name, x in values.data.items()} | moving)
        assert self.steps is not None
        problem = self._problem_of(dynamics, base_designs, along)
        again = integrate_again(self.results, problem, self.integrator, self.steps)
        if again.statistics.tangent_error is not None:
            self.stats["tangent_error"] = again.statistics.tangent_error
        return self._outputs(again).tangents(count)

    def _outputs(self, results: LaneResults) -> Outputs:
        """With the data that locks change."""
        data = {}
        if results.data is not None:
            lanes = results.history.q.shape[-1]
            wide = {name: results.data[name] for name in MARKED if name in self.names}
            data = {name: linear(lambda y: y.expand(*y.shape[:-1], lanes), x) for name, x in wide.items()}
        return Outputs.of(results.history, results.switches, self.validity, data)
