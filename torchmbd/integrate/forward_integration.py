"""A motion with the tangents of its design variables, integrated together; see motion.py.

    inputs    designs by name [component..., 1, lanes]
    outputs   outputs.py, with the data of the reduced model that move with the design

The structure stage is part of it. Serves every method, and phases; forward and reverse mode multiply with the tangents.
Checked in tests/integrate/test_motion.py, tests/sensitivity/.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.backend import with_backend
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrated_motion import IntegratedMotion
from torchmbd.integrate.motion import Tensors
from torchmbd.integrate.outputs import Outputs
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.phase import Phase
from torchmbd.integrate.phases.segment import actions_of, keep_equations, segments_of
from torchmbd.math.pair import Pair
from torchmbd.multibody.forces.action import Action
from torchmbd.multibody.system import System
from torchmbd.multibody.system.design_variables import unit_directions


@dataclass(eq=False, kw_only=True)
class ForwardIntegration(IntegratedMotion):
    """By any integrator.

    variables  names of the inputs whose tangents are integrated;  labels: one for each of their entries
    phases     as in `simulate`;  actions: of each of them
    """

    system: System  # pyright: ignore[reportIncompatibleVariableOverride]
    variables: tuple[str, ...]
    labels: tuple[str, ...]
    phases: Sequence[Phase]
    actions: tuple[tuple[Action, ...], ...] = field(default=(), init=False)
    _tangents: list[Tensor] = field(default_factory=list, init=False)

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        designs = {name: x.squeeze(-2).movedim(-1, 0) for name, x in zip(self.names, inputs, strict=True)}
        lanes = max((len(x) for x in designs.values()), default=1)
        designs = {name: x.expand(lanes, *x.shape[1:]).contiguous() for name, x in designs.items()}
        self.problem = self._problem(designs)
        self.integrate(self.problem, len(self.labels))
        if self.problem.keeps_equations:
            self.dynamics.evaluate_rank()
        data = {name: x for name, x in self.dynamics.data.items() if isinstance(x, Pair) or x.shape[-1] > 1}
        self.outputs = Outputs.of(self.history, self.switches, self.validity, data)
        self._tangents = self.outputs.tangents(len(self.labels))
        return self.outputs.values()

    def _problem(self, designs: dict[str, Tensor]) -> InitialValueProblem:
        """The structure stage."""
        whole, _ = segments_of(self.system, self.phases, self.duration)
        dynamics = whole.dynamics(designs, tangents=self.variables)
        system = self.system.with_modes(dynamics.topology.mode_counts)
        self.system, segments = segments_of(system, self.phases, self.duration)
        dynamics = replace(self.system.equations(), data=dynamics.data)
        self.actions = actions_of(segments, dynamics.topology)
        work = self.integrator.work if keep_equations(segments, dynamics.topology) else ()
        dynamics = with_backend(dynamics, self.backend, work)
        events = designs if any(segment.ends_by_event for segment in segments) else {}
        directions = unit_directions({name: designs[name] for name in self.variables if name in events})
        views = Views.of(self.system, dynamics, events, directions)
        return InitialValueProblem(dynamics, segments, views, self.duration)

    def tangents(self, directions: Tensors) -> list[Tensor]:
        if not self.variables:
            raise InputError(
                "gradients",
                "none",
                "must have gradients='auto' or 'forward'",
                state="is being differentiated",
                noun="a motion with gradients='none'",
            )
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
        return [self.of_sound_lanes(x) for x in products]

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        parts = [
            torch.einsum("krl,kbl->brl", y.flatten(0, -3), dx.flatten(0, -3).expand(-1, -1, y.shape[-1]))
            for y, dx in zip(outputs, self._tangents, strict=True)
            if y is not None
        ]
        lanes = len(self.status)
        total = torch.stack([x.expand(*x.shape[:-1], lanes) for x in parts]).sum(0)
        split = self.of_sound_lanes(total).split([self._size(name) for name in self.variables])
        by_name = dict(zip(self.variables, split, strict=True))
        parameters = dict(self.system.named_parameters())
        return [
            by_name[n].reshape(*parameters[n].shape, *total.shape[1:]) if n in by_name else None for n in self.names
        ]

    def _size(self, name: str) -> int:
        return dict(self.system.named_parameters())[name].numel()
