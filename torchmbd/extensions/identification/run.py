"""An experiment with a batch of designs: its motion, made when a measurement asks for it.

Checked in tests/extensions/identification/test_experiment.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.design.differentiate import ValueAndGradient, differentiate, push_forward
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System
from torchmbd.simulation import Simulation
from torchmbd.simulation.equilibrium import Equilibrium, equilibrium


@dataclass(eq=False)
class Run:
    """See the module header.

    system, duration   of the experiment [s]
    designs      values of the unknown parameters that the system has, by name [lanes, ...]
    settings     values of other parameters, by name
    simulation   of the system, which makes its motions
    lanes        of the batch
    gradients    whether derivatives with respect to the unknown parameters are wanted
    """

    system: System
    duration: float
    designs: Mapping[str, Tensor]
    settings: Mapping[str, Tensor]
    simulation: Simulation
    lanes: int
    gradients: bool

    @property
    def variables(self) -> list[str]:
        """Parameters by which is differentiated, in the order of gradients."""
        return list(self.designs)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """All parameters that this run sets, by name [lanes, ...]."""
        return {name: x.expand(self.lanes, *x.shape) for name, x in self.settings.items()} | {**self.designs}

    @property
    def rest_start(self) -> Any:
        """Where the search for an equilibrium begins, as the motion does; one that starts at rest begins it assembled."""
        start = self.simulation.start
        return "assembled" if isinstance(start, str) and start == "equilibrium" else start

    @property
    def status(self) -> list[str]:
        """Status of the motion of every lane."""
        status = self.motion.status
        return status if len(status) == self.lanes else status * self.lanes

    @cached_property
    def motion(self) -> Trajectory:
        """The motion of all lanes, with its tangents where gradients are wanted; of one lane where it sets no parameters."""
        if self.gradients and self.designs:
            return self.simulation(self.parameters, "forward", self.variables)
        return self.simulation(self.parameters, "none")

    def equilibrium(self, system: System, **options: Any) -> Equilibrium:
        """The equilibrium of all lanes of the system, or of one with the same parameters; options as in `equilibrium`."""
        differentiable = self.gradients and bool(self.variables)
        designs = {
            name: x.detach().clone().requires_grad_(differentiable and name in self.variables)
            for name, x in self.parameters.items()
        }
        with torch.set_grad_enabled(differentiable):
            variables = self.variables if differentiable else None
            return equilibrium(system, designs=designs, variables=variables, start=self.rest_start, **options)

    def of_motion(self, f: Callable[[Trajectory], Tensor]) -> ValueAndGradient:
        """A function of the motion [lanes, rows], with its gradient with respect to the variables where it is wanted."""
        if self.gradients and self.designs:
            return push_forward(f, self.motion)
        value, _ = differentiate(f, self.motion)
        value = value.expand(self.lanes, -1)
        gradient = torch.zeros(*value.shape, 0, dtype=torch.float64) if self.gradients else None
        return ValueAndGradient(value, gradient)
