"""How a motion was simulated, to simulate it again with other steps, more modes, or finer meshes.

Checked in tests/design/test_response_errors.py, tests/design/test_errors_of_motions.py.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.ode import ADAPTIVE
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.richer_start import with_other_modes
from torchmbd.integrate.torchdiffeq_method import Torchdiffeq
from torchmbd.multibody.system import System
from torchmbd.multibody.system.richer import finer_mesh_system, richer_system

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
        options = dict(self.options)
        if self.order is None:
            assert isinstance(self.integrator, Torchdiffeq)
            share = _TIGHTER ** (factor // 2)
            options |= {"rtol": max(_LEAST_RTOL, self.integrator.rtol * share), "atol": self.integrator.atol * share}
        return self._again(self.system, factor * self.steps, self.arguments, options)

    def coarser(self) -> Any | None:
        """The motion with half as many equal steps, values only, without its warnings; None where there is none."""
        if self.order is None or self.steps % 2:
            return None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self._again(self.system, self.steps // 2, self.arguments, self.options)

    def richer(self, motion: Any) -> Any | None:
        """The same steps with more modes of all flexible bodies, values only; None where no body has further modes.

        motion   the motion of these arguments: modal coordinates of its start are those of its modes
        Raises InputError for a static equilibrium that begins with modal coordinates.
        """
        return self._with_bodies(motion, *richer_system(self.system))

    def with_finer_meshes(self, motion: Any) -> Any | None:
        """The same on meshes of twice as many cells in each direction; None where no body has such a mesh."""
        return self._with_bodies(motion, *finer_mesh_system(self.system))

    def _with_bodies(self, motion: Any, system: System, names: list[str]) -> Any | None:
        if not names:
            return None
        return self._again(system, self.steps, with_other_modes(motion, system, self.arguments), self.options)

    def _again(self, system: System, steps: int, arguments: Mapping[str, Any], options: Mapping[str, Any]) -> Any:
        for name, x in self.system.named_parameters():
            if not torch.equal(x.detach(), self.parameters[name]):
                raise InputError(f"parameter {name!r} has changed since the motion; allowed: simulate again")
        if arguments["phases"] is not None:  # times without gradients, and joints of any copy of the system
            arguments = {**arguments, "phases": [_plain(phase) for phase in arguments["phases"]]}
        return self.simulate(system, steps=steps, gradients="none", progress=False, **arguments, **options)


def _plain(phase: Any) -> Any:
    times = {key: getattr(phase, key) for key in ("until", "lasting")}
    joints = {key: [getattr(x, "name", x) for x in getattr(phase, key)] for key in ("lock", "release")}
    return replace(phase, **{k: x.detach() if isinstance(x, Tensor) else x for k, x in times.items()}, **joints)


def parameters_of(system: System) -> dict[str, Tensor]:
    """Copies of the values of all parameters."""
    return {name: x.detach().clone() for name, x in system.named_parameters()}
