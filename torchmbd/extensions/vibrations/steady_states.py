"""States of designs at rest or at several speeds of rotation, and the eigenvalues of vibrations about them.

Drives that turn the whole at a constant speed turn at each of the speeds: a speed is one of the machine, not of its drives.
Checked in tests/extensions/vibrations/test_steady_states.py,
tests/extensions/vibrations/measures/test_system_vibrations.py,
tests/extensions/vibrations/measures/test_critical_values.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.extensions.vibrations.eigenvalues import Choice, eigenvalues
from torchmbd.integrate.arguments import checked_designs, start_of
from torchmbd.integrate.motion import Motion
from torchmbd.integrate.variables import lanes_of_batch, variable_names
from torchmbd.math.checked_numbers import differentiable_reals, reals
from torchmbd.math.gradients import all_true
from torchmbd.math.module_call import exclusive
from torchmbd.multibody.bodies.frame import axis_index
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equilibrium.coordinate_scale import coordinate_scale
from torchmbd.multibody.equilibrium.equilibrium import SPIN
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import TURNING, SteadyRotation
from torchmbd.multibody.system import Dynamics, System
from torchmbd.simulation.equilibrium import StaticIntegration


@dataclass(frozen=True)
class Shaft:
    """The axis about which a machine turns as a whole, and who looks at its vibrations.

    axis      "x", "y" or "z" of the ground, or a vector [3], whose length does not matter
    center    a point of it [m]
    observer  "turning" with the machine, or in the "ground", as in mbd.equilibrium

    >>> from torchmbd.extensions.vibrations.steady_states import Shaft
    >>> Shaft("x", observer="ground").direction.tolist()
    [1.0, 0.0, 0.0]
    """

    axis: str | Sequence[float] | Tensor = "z"
    center: Sequence[float] | Tensor = (0.0, 0.0, 0.0)
    observer: str = TURNING

    def __post_init__(self) -> None:
        SteadyRotation.of(self.direction, self.center, self.observer)
        for name in ("axis", "center"):
            x = getattr(self, name)
            object.__setattr__(self, name, x if isinstance(x, str) else tuple(reals(name, x).tolist()))

    @property
    def direction(self) -> Tensor:
        """Unit vector [3]."""
        if isinstance(self.axis, str):
            return torch.eye(3, dtype=torch.float64)[axis_index(self.axis)]
        x = reals("axis", self.axis)
        if x.shape != (3,) or not bool(torch.isfinite(x).all()) or not bool(x.any()):
            raise InputError("axis", self.axis, "'x', 'y', 'z' or a vector of three numbers")
        return x / x.norm()

    def rotation(self, speeds: Tensor) -> SteadyRotation:
        """The rotation at speeds [n], as n lanes."""
        turning = SteadyRotation.of(speeds[:, None] * self.direction, self.center, self.observer)
        kind = SteadyRotation.of(self.direction, self.center, self.observer)
        assert kind is not None
        spin = torch.zeros(3, 1, len(speeds), dtype=torch.float64) if turning is None else turning.spin
        return replace(kind, spin=spin, drives_follow=True)


@dataclass(frozen=True, eq=False)
class SteadyStates:
    """States of `designs` x `speeds` lanes, speeds running faster.

    dynamics    equations of motion with the data of all lanes, among them the spin
    q           coordinates [n_q, 1, lanes]; both are functions of the designs and of the speeds
    modes       [designs or 1, nodes, 6, modes] of the flexible bodies by their names
    """

    dynamics: Dynamics
    q: Tensor
    rotation: SteadyRotation
    t: Tensor
    speeds: int
    modes: Mapping[str, Tensor]

    def eigenvalues(
        self,
        kind: str,
        modes: Sequence[int] | Choice | None = None,
        symmetric: bool = False,
        mean: bool = False,
    ) -> Tensor:
        """Eigenvalues [designs, speeds, k], as in eigenvalues.py."""
        values = eigenvalues(self.dynamics, self.q, self.t, self.rotation, kind, modes, symmetric, mean)
        return values.T.unflatten(0, (-1, self.speeds))

    @property
    def sizes(self) -> list[float]:
        """Size of the machine of each lane [m], as in coordinate_scale.py."""
        T, q = self.dynamics.topology, self.q.detach()
        data = {name: x.detach() for name, x in self.dynamics.values().data.items()}
        return coordinate_scale(T, data, equations.placement(T, data, q, T.prescribed(self.t, data)), q)[0].tolist()

    def linearization(self, lane: int) -> Linearization:
        """The linearized equations of a lane."""
        dynamics = self.dynamics.values().select_lanes([lane])
        rotation = self.rotation.of_spin(dynamics.data[SPIN].detach())
        return Linearization.of(dynamics, self.q[:, 0, lane].detach(), self.t, None, rotation)


def steady_states(
    system: System,
    speeds: Tensor | Sequence[float] = (0.0,),
    shaft: Shaft | None = None,
    designs: Mapping[str, Tensor] | None = None,
    t: float = 0.0,
) -> SteadyStates:
    """States of steady rotation of all designs at all speeds [n] [rad/s], rising; InputError if there is none."""
    return _steady_states(system, speeds, shaft or Shaft(), designs, t)


@exclusive
def _steady_states(
    system: System, speeds: Any, shaft: Shaft, designs: Mapping[str, Tensor] | None, t: float
) -> SteadyStates:
    w = differentiable_reals("speeds", speeds, "rising speeds [n] [rad/s]").reshape(-1)
    if not len(w) or not all_true(torch.isfinite(w)) or not all_true(w.diff() > 0.0):
        raise InputError("speeds", speeds, "rising finite speeds [n] [rad/s]")
    rotation = shaft.rotation(w)
    system = system.starting(replace(start_of(system, "assembled"), is_guess=True))
    design_values = checked_designs(system, designs)
    with torch.inference_mode(False), torch.set_grad_enabled(torch.is_grad_enabled()):
        names = variable_names(system, design_values, "auto", None, False)
        dynamics, modes = system.stages(lanes_of_batch(system, design_values, names))
        n, lanes = len(w), dynamics.lanes
        data = {k: x.repeat_interleave(n, -1) if x.shape[-1] > 1 else x for k, x in dynamics.data.items()}
        data[SPIN] = rotation.spin.repeat(1, 1, lanes)
        time = torch.tensor([t], dtype=torch.float64)
        integration = StaticIntegration(replace(dynamics, data={}), tuple(data), time, False, rotation, False, n)
        outputs: Any = Motion.apply(integration, *data.values())
        modes = {name: x.detach() for name, x in modes.items()}
        return SteadyStates(dynamics.with_data(data), outputs[0][-1], rotation, time[0], n, modes)
