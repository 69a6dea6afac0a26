"""A motion with the tangents of its design variables, integrated together; see motion.py.

    inputs    designs by name [component..., 1, lanes]
    outputs   q, v, v', lam [times, n, 1, lanes], the validity of the lanes (lane_status.py), where lanes have smaller steps the
              states at these (`History.at_steps`), the data of the reduced model that move with the design, and of every switch
              between phases its time and the states on both sides

The structure stage is part of it. Serves every method, and phases; forward and reverse mode multiply with the tangents.
Checked in tests/integrate/test_motion.py, tests/sensitivity/.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.lane_status import validity
from torchmbd.integrate.memory import memory_check
from torchmbd.integrate.motion import Tensors
from torchmbd.integrate.native.library import with_backend
from torchmbd.integrate.phase import Phase
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.multiphase import integrate, steps_of_phases, switch_numbers, switches_with
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.retries import integrate_by_chosen_steps, integrate_lanes
from torchmbd.integrate.segment import segments_of
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.forces.action import Action
from torchmbd.multibody.system import Dynamics, System
from torchmbd.multibody.system.design_tangents import unit_directions
from torchmbd.multibody.system.expansion import Expansion
from torchmbd.results.history import History
from torchmbd.results.motion_data import Switch


@dataclass(eq=False)
class ForwardIntegration:
    """Any integrator over a duration [s].

    names      of the inputs;  variables: those among them whose tangents are integrated
    labels     one for each entry of the variables
    steps      their number; None: chosen from the data
    system     with the locks of its phases

    Results: dynamics and history with tangents; status, stats, switches, actions.
    """

    system: System
    names: tuple[str, ...]
    variables: tuple[str, ...]
    labels: tuple[str, ...]
    duration: float
    steps: int | None
    integrator: Integrator
    phases: Sequence[Phase] | None
    backend: str
    dynamics: Dynamics = field(init=False)
    history: History = field(init=False)
    status: list[str] = field(init=False)
    validity: Tensor = field(init=False)
    stats: dict[str, Any] = field(init=False)
    switches: list[Switch] = field(default_factory=list, init=False)
    actions: tuple[tuple[Action, ...], ...] = field(default=(), init=False)
    output_data: tuple[str, ...] = field(default=(), init=False)
    _multiphase: MultiphaseRun | None = field(default=None, init=False)
    _tangents: list[Tensor] = field(default_factory=list, init=False)

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """As of `Integration`."""
        given = zip(self.names, inputs, strict=True)
        designs = {name: x.squeeze(-2).movedim(-1, 0) for name, x in given}
        lanes = max((len(x) for x in designs.values()), default=1)
        designs = {name: x.expand(lanes, *x.shape[1:]).contiguous() for name, x in designs.items()}
        if self.phases is None:
            self._without_phases(designs)
        else:
            self._through_phases(designs, self.phases)
        data = self.dynamics.data
        self.output_data = tuple(name for name, x in data.items() if isinstance(x, Pair) or x.shape[-1] > 1)
        h = self.history
        self.validity = validity(h, self.status, self.stats)
        numbers = [*(Pair(x) for x in h.states), self._constant(self.validity)]
        at_steps = h.at_steps()
        numbers += [*(Pair(x) for x in at_steps[:4]), *(self._constant(x) for x in at_steps[4:])]
        numbers += [x if isinstance(x, Pair) else self._constant(x) for x in (data[name] for name in self.output_data)]
        for switch in self.switches:
            numbers += switch_numbers(switch)
        self._tangents = [x.tangent for x in numbers]
        return tuple(value(x) for x in numbers)

    def _without_phases(self, designs: dict[str, Tensor]) -> None:
        dynamics = self.system.dynamics(designs, tangents=self.variables)
        self.dynamics = with_backend(dynamics, self.backend, self.integrator.native_kind)
        args = self.integrator, self.dynamics, self.duration
        with_gradients = self.dynamics.tangents > 0
        if self.steps is None:
            check_memory = memory_check(self.system, self.dynamics.lanes, len(self.labels), self.integrator)
            self.steps, results = integrate_by_chosen_steps(*args, with_gradients, check_memory)
        else:
            results = integrate_lanes(*args, self.steps, with_gradients)
        self.history, self.stats, self.status = results.history, results.statistics, results.status
        self.dynamics.evaluate_rank()

    def _through_phases(self, designs: dict[str, Tensor], phases: Sequence[Phase]) -> None:
        self.system, phase_models = segments_of(self.system, phases, self.duration)
        dynamics = with_backend(self.system.dynamics(designs, tangents=self.variables), self.backend, None)
        check_memory = memory_check(self.system, dynamics.lanes, len(self.labels), self.integrator)
        self.steps = steps = self.steps or steps_of_phases(
            self.system, dynamics, phase_models, designs, self.duration, self.integrator, check_memory
        )
        directions = unit_directions({name: designs[name] for name in self.variables})
        views = Views.of(self.system, dynamics, designs, directions)

        multiphase, stats, status = integrate(dynamics, phase_models, views, self.duration, steps, self.integrator)
        self._multiphase, self.dynamics, self.history = multiphase, multiphase.whole, multiphase.history
        self.stats, self.status, self.switches = stats, status, multiphase.switches
        self.actions = tuple(phase_model.topology.actions for phase_model in phase_models)

    def tangents(self, directions: Tensors) -> list[Tensor]:
        """As of `Integration`."""
        if not self.variables:
            raise InputError("a motion with gradients='none' is being differentiated; allowed: 'auto' or 'forward'")
        by_name = dict(zip(self.names, directions, strict=True))
        count = next((x.shape[-2] for x in directions if x is not None), 1)
        flat = []
        for name in self.variables:  # in their order, that of the tangents
            d, size = by_name.get(name), self._size(name)
            no_direction = torch.zeros(size, count, 1, dtype=torch.float64)
            flat.append(no_direction if d is None else d.reshape(size, count, d.shape[-1]))
        lanes = max(x.shape[-1] for x in flat)
        db = torch.cat([x.expand(*x.shape[:-1], lanes) for x in flat])
        products = (torch.einsum("...bl,bsl->...sl", dx.expand(*dx.shape[:-1], lanes), db) for dx in self._tangents)
        return [torch.where(self.validity[1] > 0.0, x, 0.0) for x in products]

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        """As of `Integration`."""
        parts = [
            torch.einsum("krl,kbl->brl", y.flatten(0, -3), dx.flatten(0, -3).expand(-1, -1, y.shape[-1]))
            for y, dx in zip(outputs, self._tangents, strict=True)
            if y is not None
        ]
        lanes = len(self.status)
        total = torch.stack([x.expand(*x.shape[:-1], lanes) for x in parts]).sum(0)
        total = torch.where(self.validity[1] > 0.0, total, 0.0)
        split = total.split([self._size(name) for name in self.variables])
        by_name = dict(zip(self.variables, split, strict=True))
        own = dict(self.system.named_parameters())
        return [by_name[n].reshape(*own[n].shape, *total.shape[1:]) if n in by_name else None for n in self.names]

    def expansion(self, data: dict[str, Any]) -> Expansion | None:
        """As of ReverseIntegration."""
        return self.history.expansion_by(data)

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor:
        """As of ReverseIntegration, with the tangents of the history."""
        if self._multiphase is not None:
            return self._multiphase.multipliers(history, data)
        return history.least_norm_multipliers(self.dynamics.least_norm, self.duration, data)

    def switches_of(self, numbers: Sequence[Tensor]) -> list[Switch]:
        """The switches with their numbers as differentiable outputs."""
        return switches_with(self.switches, numbers)

    def _size(self, name: str) -> int:
        return dict(self.system.named_parameters())[name].numel()

    def _constant(self, x: Tensor) -> Pair:
        return Pair.of(x, x.new_zeros(*x.shape[:-2], len(self.labels), x.shape[-1]))
