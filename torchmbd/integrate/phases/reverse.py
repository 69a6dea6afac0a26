"""A motion by a one-step method through phases whose reverse mode is the adjoint of its steps; see motion.py, adjoint.py.

    inputs    the data of the reduced model, then designs [component..., 1, lanes]: events and impact maps may depend on these,
              and on the mode shapes that follow from them
    outputs   q, v, v', lam [times, n, 1, lanes], the validity of the lanes (lane_status.py), the data that locks change, and of
              every switch its time and the states on both sides

Tangents are integrated when they are asked for, together with the values once more.
Checked in tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.lane_status import validity
from torchmbd.integrate.memory import memory_check
from torchmbd.integrate.motion import Tensors
from torchmbd.integrate.native import backward
from torchmbd.integrate.native.library import with_backend
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.phases.adjoint import MARKED, PhaseAdjoint, PhaseCotangents
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.lane_leaves import Key
from torchmbd.integrate.phases.multiphase import NUMBERS, integrate, steps_of_phases, switch_numbers, switches_with
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.segment import DURATION, Segment
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.system import Dynamics, System
from torchmbd.multibody.system.expansion import Expansion
from torchmbd.results.history import History
from torchmbd.results.mode_shapes import DesignShapes
from torchmbd.results.motion_data import Switch, has_failed


@dataclass(eq=False)
class ReversePhaseIntegration:
    """Equal steps over a duration [s], and steps of other sizes at switches.

    system       with the locks of its phases
    model        topology and options of the equations; its data are not used
    names        of the data;  designs: of the designs
    steps        their number; None: chosen from the data
    integrator   with a pullback of its steps
    backend      of the steps, as of `simulate`

    Results: dynamics, history, status, stats, switches.
    """

    system: System
    phase_models: list[Segment]
    model: Dynamics
    names: tuple[str, ...]
    designs: tuple[str, ...]
    duration: float
    steps: int | None
    integrator: OneStep
    backend: str
    dynamics: Dynamics = field(init=False)
    history: History = field(init=False)
    status: list[str] = field(init=False)
    validity: Tensor = field(init=False)
    stats: dict[str, Any] = field(init=False)
    switches: list[Switch] = field(default_factory=list, init=False)
    variables: tuple[str, ...] = ()  # none carries tangents along
    _multiphase: MultiphaseRun = field(init=False, repr=False)

    @property
    def output_data(self) -> tuple[str, ...]:
        """Names of the data that locks change: outputs of `Motion`."""
        return tuple(
            name
            for name in MARKED
            if name in self.names and any(phase_model.locks for phase_model in self.phase_models)
        )

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """As of `Integration`."""
        data, designs = self._split(inputs)
        model = with_backend(replace(self.model, data=data), self.backend, None)
        check_memory = memory_check(self.system, model.lanes, 0, self.integrator)
        self.steps = self.steps or steps_of_phases(
            self.system, model, self.phase_models, designs, self.duration, self.integrator, check_memory
        )
        views = Views.of(self.system, model, designs)
        self._multiphase, self.stats, self.status = self._integrate(model, views)
        self.dynamics, self.history, self.switches = (
            self._multiphase.whole,
            self._multiphase.history,
            self._multiphase.switches,
        )
        self.validity = validity(self.history, self.status, self.stats)
        return self._outputs(self._multiphase)

    def tangents(self, directions: Tensors) -> list[Tensor]:
        """As of `Integration`."""
        own = dict(zip(self.names, directions, strict=False))
        given = self._multiphase.data_without_marks
        data = {name: x if own[name] is None else Pair.of(x, _tensor(own[name])) for name, x in given.items()}
        designs = self._multiphase.views.whole.designs
        moves = zip(self.designs, directions[len(self.names) :], strict=True)
        along = {name: dx.movedim((-2, -1), (0, 1)) for name, dx in moves if dx is not None}
        along = {name: dx.expand(len(dx), len(designs[name]), *dx.shape[2:]) for name, dx in along.items()}
        model = replace(self.dynamics, data=data)
        multiphase, stats, _ = self._integrate(model, Views.of(self.system, model, designs, along))
        self.stats |= {"tangent_error": stats["tangent_error"]} if "tangent_error" in stats else {}
        h, count = multiphase.history, next(x.shape[-2] for x in directions if x is not None)
        numbers: list[Any] = [*(Pair(x) for x in (h.q, h.v, h.vd, h.lam)), self.validity]
        numbers += [multiphase.whole.data[name] for name in self.output_data]
        numbers += [x for switch in multiphase.switches for x in switch_numbers(switch)]
        found = (x.tangent if isinstance(x, Pair) else x.new_zeros(*x.shape[:-2], count, x.shape[-1]) for x in numbers)
        return [torch.where(self.validity[1] > 0.0, x, 0.0) for x in found]

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        """As of `Integration`."""
        rows = next(x.shape[-2] for x in outputs if x is not None)
        differentiated = [name for name, needed in zip(self.names, needs_grad, strict=False) if needed]
        names = [name for name in differentiated if name != DURATION]
        marks = 5 + len(self.output_data)
        switches = [outputs[i : i + NUMBERS] for i in range(marks, len(outputs), NUMBERS)]
        lanes, found = self._adjoint(names)(
            PhaseCotangents(outputs[:4], dict(zip(self.output_data, outputs[5:marks], strict=True)), switches), rows
        )
        data = {
            name: self._of_data(lanes, found.get(("data", name)), self._multiphase.data_without_marks[name], rows)
            for name in names
        }
        if DURATION in differentiated:
            pairs = [(y, dx) for y, dx in zip(outputs, self._by_duration, strict=True) if y is not None]
            data[DURATION] = torch.stack([(y * dx).flatten(0, -3).sum(0) for y, dx in pairs]).sum(0)
        designs = self._of_designs(lanes, found, rows) if any(needs_grad[len(self.names) :]) else {}
        return [data.get(name) for name in self.names] + [designs.get(name) for name in self.designs]

    @cached_property
    def _by_duration(self) -> list[Tensor]:
        """Tangents of all outputs by the duration, by operators of torch."""
        self.stats["gradient by the duration"] = "eager"
        inputs = [*self.names, *self.designs]
        return self.tangents([torch.ones(1, 1, dtype=torch.float64) if x == DURATION else None for x in inputs])

    def expansion(self, data: dict[str, Any]) -> Expansion | None:
        """As of ReverseIntegration."""
        return None

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor:
        """As of ReverseIntegration."""
        return self._multiphase.multipliers(history, data)

    def switches_of(self, numbers: Sequence[Tensor]) -> list[Switch]:
        """The switches with their numbers as differentiable outputs."""
        return switches_with(self.switches, numbers)

    def _split(self, inputs: Sequence[Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        n = len(self.names)
        data = dict(zip(self.names, inputs[:n], strict=True))
        return data, {k: x.squeeze(-2).movedim(-1, 0) for k, x in zip(self.designs, inputs[n:], strict=True)}

    def _integrate(self, model: Dynamics, views: Views) -> tuple[MultiphaseRun, dict[str, Any], list[str]]:
        assert self.steps is not None
        return integrate(model, self.phase_models, views, self.duration, self.steps, self.integrator)

    def _outputs(self, multiphase: MultiphaseRun) -> tuple[Tensor, ...]:
        h, data = multiphase.history, multiphase.whole.data
        lanes = h.q.shape[-1]
        marks = [data[name].expand(*data[name].shape[:-1], lanes) for name in self.output_data]
        return (
            h.q,
            h.v,
            h.vd,
            h.lam,
            self.validity,
            *marks,
            *(value(x) for s in multiphase.switches for x in switch_numbers(s)),
        )

    def _adjoint(self, names: Sequence[str]) -> PhaseAdjoint:
        failed = [lane for lane, status in enumerate(self.status) if has_failed(status)]
        return PhaseAdjoint(self._multiphase, self.integrator, names, failed, backward.adjoint_solver)

    def _of_data(self, lanes: list[int], by: Tensor | None, like: Tensor, rows: int) -> Tensor:
        """Cotangents [component..., rows, lanes] of data [component..., 1, lanes]; of lanes that failed zero."""
        result = like.new_zeros(*like.shape[:-2], rows, len(self.status))
        if by is not None:
            result[..., lanes] = by[..., 0, :].movedim(0, -2)
        return result

    def _of_designs(self, lanes: list[int], by: dict[Key, Tensor], rows: int) -> dict[str, Tensor]:
        """Of designs [component..., rows, lanes]: their own, and those of the mode shapes through the structure stage."""
        whole = self._multiphase.views.whole
        kinds = {key for key in by if key[0] != "data"}
        with torch.enable_grad():
            designs = {name: x.detach().clone().requires_grad_() for name, x in whole.designs.items()}
            shapes = DesignShapes(self.system, designs, len(self.status))
            outputs = {(k, n): designs[n] if k == "design" else shapes.values(n) for k, n in kinds}
        cotangents = {key: x.new_zeros(rows, *x.shape) for key, x in outputs.items()}
        for key in kinds:
            cotangents[key][:, lanes] += by[key]
        used = [key for key in kinds if outputs[key].requires_grad]
        result = {name: x.new_zeros(rows, *x.shape) for name, x in designs.items()}
        for row in range(rows) if used else ():
            options: dict[str, Any] = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
            of, weights = [outputs[key] for key in used], [cotangents[key][row] for key in used]
            for name, x in zip(
                designs, torch.autograd.grad(of, list(designs.values()), weights, **options), strict=True
            ):
                result[name][row] = x
        return {name: x.movedim((0, 1), (-2, -1)) for name, x in result.items()}


def _tensor(x: Tensor | None) -> Tensor:
    assert x is not None
    return x
