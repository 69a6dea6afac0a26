"""How a motion was simulated, to simulate it again with finer steps.

Checked in tests/design/test_response_errors.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.ode import ADAPTIVE
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.torchdiffeq_method import Torchdiffeq
from torchmbd.multibody.system import System

_TIGHTER = 0.01  # tolerances of adaptive methods, for each halving of the output intervals
_LEAST_RTOL = 1e-13  # rounding is above it


@dataclass(frozen=True, eq=False, repr=False)
class Simulation:
    """The arguments of `simulate` for one motion.

    steps      of the motion, also where they were chosen
    parameters values that the system had
    """

    simulate: Callable[..., Any]
    system: System
    integrator: Integrator
    steps: int
    arguments: Mapping[str, Any]
    options: Mapping[str, Any]
    parameters: Mapping[str, Tensor]

    @property
    def order(self) -> int | None:
        """Order of the method; None: adaptive. InputError for a method without an estimate."""
        if isinstance(self.integrator, OneStep):
            return 2
        if self.integrator.name in ADAPTIVE:
            return None
        raise InputError(
            f"errors by steps of method {self.integrator.name!r}; allowed: generalized_alpha, hht_alpha, or an "
            f"adaptive method ({', '.join(sorted(ADAPTIVE))})"
        )

    def finer(self, factor: int) -> Any:
        """The motion with `factor` (2 or 4) times the steps, values only; adaptive methods with tighter tolerances."""
        for name, x in self.system.named_parameters():
            if not torch.equal(x.detach(), self.parameters[name]):
                raise InputError(f"parameter {name!r} has changed since the motion; allowed: simulate again")
        options = dict(self.options)
        if self.order is None:
            assert isinstance(self.integrator, Torchdiffeq)
            share = _TIGHTER ** (factor // 2)
            options |= {"rtol": max(_LEAST_RTOL, self.integrator.rtol * share), "atol": self.integrator.atol * share}
        return self.simulate(
            self.system, steps=factor * self.steps, gradients="none", progress=False, **self.arguments, **options
        )


def parameters_of(system: System) -> dict[str, Tensor]:
    """Copies of the values of all parameters."""
    return {name: x.detach().clone() for name, x in system.named_parameters()}
