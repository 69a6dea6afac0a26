"""Consistent initial conditions: joints closed by Newton's method, then compatible velocities.

Modal coordinates start at zero, undeformed and at rest in their body frames; the rigid coordinates move as little as
possible (minimum norm) from the given approximate positions and velocities:

    q <- q o s,  s = -J+ Phi(q, t0)          repeated until closed
    v = v0 + s,  s = -J+ (J v0 + Phi_t)

J      Jacobian Phi_q of the rigid coordinates at the place of the step, J+ its pseudo-inverse: redundant and
       underdetermined mechanisms alike
y      multipliers of the correction, s = J' y

The derivatives by the design are those of these steps: with P = 1 - J+ J the projector on what the joints leave free,

    ds = P dJ' y - J+ (dPhi + dJ s)          of a velocity with d(J v0 + Phi_t) for dPhi

On pairs, or on tensors that require gradients, every step carries them; a last one the position's at the closed joints.
What cannot close is named with its residual.
Of undeformed bodies nothing but the attached points and the laws of drives enters. Where those are no part of the design,
all designs start alike, and what is found for the first serves all (`Alike`).
Source: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432 (pseudo-inverse of constant rank).
Checked in tests/system/test_initial.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.numerics.pair import Pair, cat, linear, value
from torchmbd.numerics.rotation import euler_parameters
from torchmbd.system import equations
from torchmbd.system.condensation import Condensation, condense
from torchmbd.system.rank import Rank
from torchmbd.system.topology import Topology

_CLOSED = 1e-11  # [m] or [-]: largest violation of a closed joint
_STEPS = 50


@dataclass(frozen=True, eq=False)
class Alike:
    """What designs that start alike share.

    seen   attached points, and laws with their slopes at the start
    q, v   the initial state [n, 1, 1]
    ranks  of the constraints of a topology, where no mode of a body is needed to tell
    """

    seen: list[Tensor]
    q: Tensor
    v: Tensor
    ranks: dict[Topology, Rank]


@dataclass(frozen=True, eq=False)
class InitialConditions:
    """Approximate initial positions q [n_q] and velocities v [n_v] of all bodies, modes at rest."""

    topology: Topology
    q: Tensor
    v: Tensor
    _last: list[Alike] = field(default_factory=list, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_last": []}  # what was found for some designs is no part of the model

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

    def alike(self, dynamics: Any) -> Alike | None:
        """What all designs of these data share; None if their starts depend on the design. Raises InputError as `solve`."""
        T, x = self.topology, dynamics.data["x"]
        if not T.rows or T.varied or isinstance(x, Pair) or x.requires_grad or x.shape[-1] > 1:
            return None
        laws = [drive for drive in T.law_jets(x.new_zeros(()), dynamics.data) if drive]
        seen = [x, *(part for drive in laws for jet in drive for part in jet.parts)]
        if not self._last or not all(map(torch.equal, seen, self._last[0].seen)):
            data = {name: value(y).detach()[..., :1] for name, y in dynamics.data.items()}
            if "Y" in data:
                data["Y"] = torch.zeros_like(data["Y"])
            self._last[:] = [Alike(seen, *self._closed(replace(dynamics, data=data)), {})]
        return self._last[0]

    def solve(self, dynamics: Any):
        """Initial q [n_q, 1, lanes] and v [n_v, 1, lanes]; pairs where they depend on data that are.

        Raises InputError naming the joints that do not close.
        """
        if dynamics.alike is None:
            return self._closed(dynamics)
        return tuple(x.expand(-1, 1, dynamics.lanes).contiguous() for x in (dynamics.alike.q, dynamics.alike.v))

    def _closed(self, dynamics: Any):
        T, data = self.topology, dynamics.data
        device = value(data["x"]).device
        lanes = dynamics.lanes
        t = torch.zeros((), dtype=torch.float64, device=device)
        q = self.q.to(device)[:, None, None].expand(-1, 1, lanes).contiguous()
        v = self.v.to(device)[:, None, None].expand(-1, 1, lanes).contiguous()
        if not T.rows:
            return q, v
        for _ in range(_STEPS):
            tied = _Tied.of(dynamics, q, t)
            phi = tied.violation()
            if float(value(phi).detach().abs().max()) < _CLOSED:
                break
            s = -tied.least(value(phi).detach())
            q = equations.advance(T, q, s + tied.turned(s) - tied.least(phi + tied.rates(s) - tied.rates(0.0 * s)))
        else:
            self._refuse(value(phi).detach())
        q = equations.advance(T, q, -tied.least(phi))
        tied = _Tied.of(dynamics, q, t)
        s = -tied.least(value(tied.rates(v)).detach())
        return q, v + s + tied.turned(s) - tied.least(tied.rates(v + s))

    def _refuse(self, phi: Tensor) -> None:
        T, phi = self.topology, phi.abs().amax((1, 2))
        worst = torch.argsort(phi, descending=True)[:4]
        rows = "; ".join(f"{T.row_names[i]} misses by {float(phi[i]):.3g}" for i in worst.tolist() if phi[i] > _CLOSED)
        raise InputError(
            f"the mechanism does not close at the given positions, lengths and axes: {rows}. "
            "Allowed: positions from which Newton's method can close all joints"
        )


@dataclass(frozen=True, eq=False)
class _Tied:
    """The joints of all lanes at the coordinates q and the time t."""

    dynamics: Any
    at: equations.Placement
    t: Tensor
    J: Tensor  # [lanes, rows, 6 bodies], without derivatives
    inverse: Tensor  # [lanes, 6 bodies, rows]

    @classmethod
    def of(cls, dynamics: Any, q, t: Tensor) -> _Tied:
        T, data = dynamics.topology, dynamics.data
        values = {name: value(x).detach() for name, x in data.items()}
        plain = equations.placement(T, values, value(q).detach(), T.prescribed(t, values))
        J = dynamics.saddle.jacobian(values, plain)[:, :, : 6 * T.bodies]
        at = equations.placement(T, data, q, T.prescribed(t, data))
        return cls(dynamics, at, t, J, torch.linalg.pinv(J, rtol=1e-10))

    def violation(self):
        """Phi [rows, ...]."""
        return equations.constraints(self.dynamics.topology, self.at)

    def rates(self, v: Tensor):
        """Phi' = J v + Phi_t [rows, ...]."""
        T, data = self.dynamics.topology, self.dynamics.data
        return equations.constraint_jets(T, self.at, data, v, torch.zeros_like(v), self.t).velocity

    def least(self, x):
        """J+ x [n_v, ...] of x [rows, ...]; modal rows zero."""
        return linear(lambda y: self._whole(_times(self.inverse, y)), x)

    def turned(self, s: Tensor):
        """P J' y [n_v, ...] of a correction s = J' y, with the derivatives of J: they are all that is not zero."""
        T, data, rigid = self.dynamics.topology, self.dynamics.data, self.J.shape[2]
        y = _times(self.inverse.mT, s[:rigid])
        force = cat([x.flatten(0, 1) for x in equations.constraint_forces(T, data, self.at, y)])[:rigid]
        return linear(lambda f: self._whole(f - _times(self.inverse, _times(self.J, f))), force)

    def _whole(self, rigid: Tensor) -> Tensor:
        return torch.cat([rigid, rigid.new_zeros(self.dynamics.topology.n_v - len(rigid), *rigid.shape[1:])])


def _times(A: Tensor, x: Tensor) -> Tensor:
    """Matrices [lanes, n, k] times numbers [k, slots, lanes]."""
    return (A @ x.permute(2, 0, 1)).permute(1, 2, 0)
