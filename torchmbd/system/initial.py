"""Consistent initial conditions: joints closed by Newton's method, then compatible velocities.

Modal coordinates start at zero, undeformed and at rest in their body frames; the rigid coordinates move as little as
possible (minimum norm) from the given approximate positions and velocities:

    Phi(q, t0) = 0          dq = -Phi_qr^+ Phi, repeated
    Phi_qr v = -Phi_t       v = v0 - Phi_qr^+ (Phi_qr v0 + Phi_t)

The pseudo-inverse serves redundant and underdetermined mechanisms alike.
What cannot close is named with its residual. One further Newton step on pairs, or on tensors that require gradients,
carries the derivatives of the initial state (implicit function theorem); where joints leave freedoms, those of least norm.
Checked in tests/system/test_initial.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.numerics.pair import linear, value
from torchmbd.numerics.rotation import euler_parameters
from torchmbd.system import equations
from torchmbd.system.condensation import Condensation, condense
from torchmbd.system.topology import Topology

_CLOSED = 1e-11  # [m] or [-]: largest violation of a closed joint
_STEPS = 50


@dataclass(frozen=True, eq=False)
class InitialConditions:
    """Approximate initial positions q [n_q] and velocities v [n_v] of all bodies, modes at rest."""

    topology: Topology
    q: Tensor
    v: Tensor

    @classmethod
    def of(cls, topology: Topology, bodies: list[Any]) -> InitialConditions:
        """Collect what the bodies were given; `bodies` in the order of the topology."""
        modal = torch.zeros(topology.modes * topology.flexible, dtype=torch.float64)
        q = [
            torch.stack([b.position for b in bodies], 1).flatten(),
            torch.stack([euler_parameters(b.axes) for b in bodies], 1).flatten(),
            modal,
        ]
        v = [
            torch.stack([b.velocity for b in bodies], 1).flatten(),
            torch.stack([b.angular_velocity for b in bodies], 1).flatten(),
            modal,
        ]
        return cls(topology, torch.cat(q), torch.cat(v))

    @cached_property
    def condensed(self) -> Condensation | None:
        """What is left when the joints to the ground are solved for good; None if that is everything."""
        return condense(self.topology, self.q) if self.topology.rows else None

    def solve(self, dynamics: Any):
        """Initial q [n_q, 1, lanes] and v [n_v, 1, lanes]; pairs if the data of `dynamics` are.

        Raises InputError naming the joints that do not close.
        """
        T, data = self.topology, dynamics.data
        device = value(data["x"]).device
        lanes = dynamics.lanes
        t = torch.zeros((), dtype=torch.float64, device=device)
        q = self.q.to(device)[:, None, None].expand(-1, 1, lanes).contiguous()
        v = self.v.to(device)[:, None, None].expand(-1, 1, lanes).contiguous()
        if not T.rows:
            return q, v
        values = {name: value(x).detach() for name, x in data.items()}
        for _ in range(_STEPS):
            inverse = self._inverse(dynamics, values, q, t)
            q_new, violation = self._newton(inverse, values, q, t)
            if violation < _CLOSED:
                break
            q = q_new
        else:
            self._refuse(values, q, t)
        q, _ = self._newton(inverse, data, q, t)
        inverse = self._inverse(dynamics, values, q, t)
        v = v - self._apply(inverse, self._rates(values, value(q).detach(), v, t))
        # At compatible velocities the rates are zero, but not their derivatives by the design: Phi_q changes with it.
        return q, v - self._apply(inverse, self._rates(data, q, v, t))

    def _rates(self, data: equations.Data, q, v: Tensor, t: Tensor):
        T = self.topology
        at = equations.placement(T, data, q, T.prescribed(t, data))
        return equations.constraint_jets(T, at, data, v, torch.zeros_like(v), t).velocity

    def _newton(self, inverse: Tensor, data: equations.Data, q, t: Tensor):
        T = self.topology
        phi = equations.constraints(T, equations.placement(T, data, q, T.prescribed(t, data)))
        return equations.advance(T, q, -self._apply(inverse, phi)), float(value(phi).detach().abs().max())

    def _inverse(self, dynamics: Any, values: equations.Data, q, t: Tensor) -> Tensor:
        """Pseudo-inverse of the Jacobian by the rigid coordinates [lanes, 6 bodies, rows]."""
        T = self.topology
        at = equations.placement(T, values, value(q).detach(), T.prescribed(t, values))
        J = dynamics.saddle.jacobian(values, at)[:, :, : 6 * T.bodies]
        return torch.linalg.pinv(J, rtol=1e-10)

    def _apply(self, inverse: Tensor, x):
        """Multiply [rows, slots, lanes] by the pseudo-inverse; modal rows zero."""
        T = self.topology

        def multiply(y: Tensor) -> Tensor:
            rigid = (inverse @ y.permute(2, 0, 1)).permute(1, 2, 0)
            return torch.cat([rigid, rigid.new_zeros(T.n_v - 6 * T.bodies, *rigid.shape[1:])])

        return linear(multiply, x)

    def _refuse(self, values: equations.Data, q: Tensor, t: Tensor) -> None:
        T = self.topology
        phi = equations.constraints(T, equations.placement(T, values, q, T.prescribed(t, values))).abs().amax((1, 2))
        worst = torch.argsort(phi, descending=True)[:4]
        rows = "; ".join(f"{T.row_names[i]} misses by {float(phi[i]):.3g}" for i in worst.tolist() if phi[i] > _CLOSED)
        raise InputError(
            f"the mechanism does not close at the given positions, lengths and axes: {rows}. "
            "Allowed: positions from which Newton's method can close all joints"
        )
