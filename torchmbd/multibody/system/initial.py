"""Consistent initial conditions: joints closed by Newton's method, then compatible velocities.

Modal coordinates start at zero, undeformed and at rest in their body frames; the rigid coordinates move as little as
possible (minimum norm) from the given approximate positions and velocities. Velocities g that were given change only where
those f that were not cannot make up for it; these are as small as possible:

    q <- q o s,  s = -K Phi(q, t0)           repeated until closed; all coordinates are given
    v = v0 + s,  s = -K (J v0 + Phi_t)       v0 = 0 where no velocity was given

    J = G + F     Jacobian Phi_q of the rigid coordinates at the place of the step: columns of g, columns of f
    B = Q G       Q = 1 - F F+: what f cannot make up for;  + is the pseudo-inverse: redundant and underdetermined
    K = C + F+ (1 - G C),  C = B+ Q                         mechanisms alike. K = J+ where all, or none, are given

The derivatives by the design are those of these steps. With the multipliers y = C' s of g, z = F+' s of f,

    ds = u - C G u + w - F+ (G (u - C G u) + F w) - K (dPhi + dJ s)     u = dG' y - G' F+' dF' y,  w = dF' z

and d(J v0 + Phi_t) of a velocity for dPhi. A given velocity that is not kept gives a warning.

On pairs, or on tensors that require gradients, every step carries them; a last one the position's at the closed joints.
What cannot close is named with its residual.
Of undeformed bodies nothing but the attached points and the laws of drives enters. Where those are no part of the design,
all designs start alike, and what is found for the first serves all (`Alike`). Positions and velocities that are Parameters of
bodies are data of a design, "q0" and "v0".
Source: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432 (pseudo-inverse of constant rank).
Checked in tests/multibody/system/test_initial.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.math.pair import Pair, cat, linear, value
from torchmbd.math.rotation import euler_parameters
from torchmbd.multibody.bodies.frame import moves
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.condensation import Condensation, condense
from torchmbd.multibody.system.rank import Rank
from torchmbd.multibody.system.topology import Topology

_CLOSED = 1e-11  # [m] or [-]: largest violation of a closed joint
_STEPS = 50
_RANK = 1e-10  # share of the largest singular value of J that counts as zero
_KEPT = 1e-6  # share of the largest given velocity by which one may change without a word
_SHOWN = 4  # velocities that are not kept, the worst first


START_DATA = (
    "q0",
    "v0",
)  # where approximate initial coordinates and rates are among the data of a design, if these vary


def start_of_bodies(T: Topology, bodies: list[Any]) -> dict[str, Tensor]:
    """Coordinates [n_q, 1, lanes] and rates [n_v, 1, lanes] as bodies were given them, in the order of the topology."""

    def rows(*kinds: list[Tensor]) -> Tensor:
        lanes = max((x.shape[0] for kind in kinds for x in kind if x.dim() > 1), default=1)
        wide = [torch.stack([x.expand(lanes, -1) for x in kind], -1).flatten(1) for kind in kinds if kind]
        return torch.cat(wide, 1).T[:, None]

    def modal(name: str) -> list[Tensor]:
        own = (getattr(b, name) for b in bodies[: T.flexible])
        return [torch.nn.functional.pad(x, (0, T.modes - x.shape[-1])) for x in own]

    q = rows([b.position for b in bodies], [euler_parameters(b.axes) for b in bodies], modal("modal"))
    v = rows([b.velocity for b in bodies], [b.angular_velocity for b in bodies], modal("modal_velocity"))
    return {"q0": q, "v0": v}


@dataclass(frozen=True, eq=False)
class SharedStart:
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
    """Approximate initial positions q [n_q] and velocities v [n_v] of all bodies, modes at rest; given: those that were."""

    topology: Topology
    q: Tensor
    v: Tensor
    given: Tensor
    _last: list[SharedStart] = field(default_factory=list, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_last": []}  # what was found for some designs is no part of the model

    @classmethod
    def of(cls, topology: Topology, bodies: list[Any]) -> InitialConditions:
        """Collect what the bodies were given; `bodies` in the order of the topology."""
        start = {name: x[:, 0, 0].detach().clone() for name, x in start_of_bodies(topology, bodies).items()}
        given = torch.tensor([moves(b) for b in bodies]).T[:, None].expand(2, 3, -1).flatten()
        modal = torch.zeros(topology.n_v - len(given), dtype=torch.bool)
        return cls(topology, start["q0"], start["v0"], torch.cat([given, modal]))

    @cached_property
    def condensed(self) -> Condensation | None:
        """What is left when the joints to the ground are solved for good; None if that is everything."""
        return condense(self.topology, self.q) if self.topology.rows else None

    def shared_start(self, dynamics: Any) -> SharedStart | None:
        """What all designs of these data share; None if their starts depend on the design. Raises InputError as `solve`."""
        T, x = self.topology, dynamics.data["x"]
        if (
            not T.rows
            or T.varied
            or T.placed
            or START_DATA[0] in dynamics.data
            or isinstance(x, Pair)
            or x.requires_grad
            or x.shape[-1] > 1
        ):
            return None
        laws = [drive for drive in T.law_jets(x.new_zeros(()), dynamics.data) if drive]
        seen = [x, *(part for drive in laws for jet in drive for part in jet.parts)]
        if not self._last or not all(map(torch.equal, seen, self._last[0].seen)):
            data = {name: value(y).detach()[..., :1] for name, y in dynamics.data.items()}
            data |= {name: torch.zeros_like(data[name]) for name in ("Y", "E") if name in data}
            self._last[:] = [SharedStart(seen, *self._closed(replace(dynamics, data=data)), {})]
        return self._last[0]

    def solve(self, dynamics: Any):
        """Initial q [n_q, 1, lanes] and v [n_v, 1, lanes]; pairs where they depend on data that are.

        Raises InputError naming the joints that do not close.
        """
        if dynamics.shared_start is None:
            return self._closed(dynamics)
        return tuple(
            x.expand(-1, 1, dynamics.lanes).contiguous() for x in (dynamics.shared_start.q, dynamics.shared_start.v)
        )

    def _closed(self, dynamics: Any):
        q, v = self.assembled(dynamics)
        return q, self.compatible(dynamics, q, v)

    def assembled(self, dynamics: Any):
        """Positions q that close the joints, and rates v as they were given [n, 1, lanes]; as of `solve`."""
        T, data = self.topology, dynamics.data
        device = value(data["x"]).device
        lanes = dynamics.lanes
        t = torch.zeros((), dtype=torch.float64, device=device)
        q, v = (
            linear(lambda y: y.expand(*y.shape[:-1], lanes).contiguous(), data.get(name, own.to(device)[:, None, None]))
            for name, own in zip(START_DATA, (self.q, self.v), strict=True)
        )
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
        return equations.advance(T, q, -tied.least(phi)), v

    def compatible(self, dynamics: Any, q: Any, v: Any):
        """Rates that the joints allow at closed positions q, nearest to v; all are [n, 1, lanes]."""
        if not self.topology.rows:
            return v
        t = torch.zeros((), dtype=torch.float64, device=value(q).device)
        tied = _Tied.of(dynamics, q, t, self.given.to(t.device))
        s = -tied.least(value(tied.rates(v)).detach())
        self._tell(value(v).detach()[:, 0], s[:, 0])
        return v + s + tied.turned(s) - tied.least(tied.rates(v + s))

    def _tell(self, v: Tensor, s: Tensor) -> None:
        """Warn of velocities that were given and are not kept [n_v, lanes]."""
        n, lost = self.topology.bodies, []
        for k, (kind, unit) in enumerate((("velocity", "m/s"), ("angular velocity", "rad/s"))):
            for i, name in enumerate(self.topology.names):
                rows = [3 * n * k + n * j + i for j in range(3)]
                change, lane = s[rows].norm(dim=0).max(0)
                if self.given[rows[0]] and float(change) > _KEPT * float(v[:, lane].abs().max()):
                    own, found = (", ".join(f"{x:.4g}" for x in y[rows, lane].tolist()) for y in (v, v + s))
                    lost.append((-float(change), f"{kind} of {name!r} given ({own}), starts with ({found}) {unit}"))
        if lost:
            shown, more = [text for _, text in sorted(lost)[:_SHOWN]], len(lost) - _SHOWN
            warn(
                f"the joints do not allow the initial velocities that the bodies were given: {'; '.join(shown)}"
                + (f"; and {more} more" if more > 0 else ""),
            )

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
    G: Tensor  # [lanes, rows, 6 bodies], without derivatives, as all that follow: zero but for what is given
    F: Tensor  # zero for what is given
    inverse: Tensor  # C [lanes, 6 bodies, rows]
    inverse_free: Tensor  # F+
    given: Tensor  # [6 bodies, 1, 1]

    @classmethod
    def of(cls, dynamics: Any, q, t: Tensor, given: Tensor | None = None) -> _Tied:
        """given: which of the rigid velocities are; None: all."""
        T, data = dynamics.topology, dynamics.data
        values = {name: value(x).detach() for name, x in data.items()}
        plain = equations.placement(T, values, value(q).detach(), T.prescribed(t, values))
        J = dynamics.saddle.jacobian(values, plain)[:, :, : 6 * T.bodies]
        at = equations.placement(T, data, q, T.prescribed(t, data))
        rows, rigid = J.shape[1:]
        own = torch.ones(rigid, dtype=torch.bool, device=J.device) if given is None else given[:rigid]
        whole, small = _pseudo_inverse(J)
        G, F, none = J * own, J * ~own, torch.zeros_like(whole)
        if bool(own.all()):
            C, free = whole, none
        elif not bool(own.any()):
            C, free = none, whole
        else:
            free = torch.linalg.pinv(F, atol=small, rtol=torch.zeros_like(small))
            Q = torch.eye(rows, dtype=J.dtype, device=J.device) - F @ free
            C = torch.linalg.pinv(Q @ G, atol=small, rtol=torch.zeros_like(small)) @ Q
        return cls(dynamics, at, t, G, F, C, free, own[:, None, None])

    def violation(self):
        """Phi [rows, ...]."""
        return equations.constraints(self.dynamics.topology, self.at)

    def rates(self, v):
        """Phi' = J v + Phi_t [rows, ...]."""
        T, data = self.dynamics.topology, self.dynamics.data
        return equations.constraint_jets(T, self.at, data, v, torch.zeros_like(value(v)), self.t).velocity

    def least(self, x):
        """K x [n_v, ...] of x [rows, ...]; modal rows zero."""

        def solved(y: Tensor) -> Tensor:
            own = _times(self.inverse, y)
            return self._whole(own + _times(self.inverse_free, y - _times(self.G, own)))

        return linear(solved, x)

    def turned(self, s: Tensor):
        """What the derivatives of J make of a correction s where its constraints are kept [n_v, ...]: no -K (dPhi + dJ s)."""
        rigid = self.G.shape[2]
        moved = linear(lambda f: self._of_given(f), self._pulled(_times(self.inverse.mT, s[:rigid])))
        if bool(self.F.any()):
            free = self._pulled(_times(self.inverse_free.mT, s[:rigid]))
            moved = moved + linear(lambda f: self._of_free(f), free)
        return moved

    def _pulled(self, y: Tensor):
        """J' y [6 bodies, ...] with the derivatives of J."""
        T, data = self.dynamics.topology, self.dynamics.data
        return cat([x.flatten(0, 1) for x in equations.constraint_forces(T, data, self.at, y)])[: self.G.shape[2]]

    def _of_given(self, f: Tensor) -> Tensor:
        own = f * self.given
        u = own - _times(self.G.mT, _times(self.inverse_free.mT, f - own))
        u = u - _times(self.inverse, _times(self.G, u))
        return self._whole(u - _times(self.inverse_free, _times(self.G, u)))

    def _of_free(self, f: Tensor) -> Tensor:
        w = f * ~self.given
        return self._whole(w - _times(self.inverse_free, _times(self.F, w)))

    def _whole(self, rigid: Tensor) -> Tensor:
        return torch.cat([rigid, rigid.new_zeros(self.dynamics.topology.n_v - len(rigid), *rigid.shape[1:])])


def _pseudo_inverse(J: Tensor) -> tuple[Tensor, Tensor]:
    """J+ [lanes, n, rows], and the size of a singular value that counts as zero [lanes]."""
    U, s, V = torch.linalg.svd(J, full_matrices=False)
    small = _RANK * s[:, 0]
    inverse = torch.where(s > small[:, None], 1.0 / s, 0.0)
    return V.mT @ (inverse[..., None] * U.mT), small


def _times(A: Tensor, x: Tensor) -> Tensor:
    """Matrices [lanes, n, k] times numbers [k, pair, lanes]."""
    return (A @ x.permute(2, 0, 1)).permute(1, 2, 0)
