"""The result of a simulation: coordinates, rates, accelerations, multipliers, and their sensitivities.

Presented lanes (designs) first, then time, then components, the design axis last:

    t [times]   q [lanes, times, n_q]   v, a [lanes, times, n_v]   lam [lanes, times, rows]
    dq_db [lanes, times, n_q, n_b]   dv_db [lanes, times, n_v, n_b]

A lane that failed says why in `status`; its numbers are nan from the failure on and must not be used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, SimulationFailure, unknown
from torchmbd.numerics.pair import Pair, value
from torchmbd.numerics.rotation import rotation_matrix
from torchmbd.system.dynamics import Dynamics

OK = "ok"


@dataclass(eq=False)
class Trajectory:
    """A motion of one design or of a batch; see the module header for shapes.

    status      for each lane "ok" or the reason of the failure
    stats       what the integrator counted
    designs     parameters of the lanes by name, [lanes, ...]
    parameters  names of the design variables of the sensitivities, one for each slot
    """

    t: Tensor
    q: Tensor
    v: Tensor
    a: Tensor
    lam: Tensor
    status: list[str]
    stats: dict[str, Any]
    system: Any
    dynamics: Dynamics
    dq_db: Tensor | None = None
    dv_db: Tensor | None = None
    designs: dict[str, Tensor] = field(default_factory=dict)
    parameters: tuple[str, ...] = ()
    _views: dict[str, BodyMotion] = field(default_factory=dict, repr=False)

    @property
    def ok(self) -> bool:
        """Whether every lane succeeded."""
        return all(status == OK for status in self.status)

    def require_ok(self) -> Trajectory:
        """Return self, or raise SimulationFailure with the first reason."""
        for lane, status in enumerate(self.status):
            if status != OK:
                raise SimulationFailure(f"lane {lane}: {status}")
        return self

    def body(self, name: str) -> BodyMotion:
        """The motion of one body."""
        if name not in self.dynamics.topology.names:
            raise unknown("body", name, self.dynamics.topology.names)
        if name not in self._views:
            self._views[name] = BodyMotion(self, name)
        return self._views[name]

    def coordinates(self, rows: Sequence[int]) -> tuple[Tensor, Tensor | None]:
        """Chosen rows of q [lanes, times, k] and their sensitivities [lanes, times, k, n_b]."""
        index = torch.as_tensor(list(rows), device=self.q.device)
        return self.q[..., index], None if self.dq_db is None else self.dq_db[..., index, :]


class BodyMotion:
    """One body along a trajectory; shapes [lanes, times, ...]."""

    def __init__(self, motion: Trajectory, name: str):
        self.motion, self.name = motion, name
        self._T = motion.dynamics.topology
        self._index = self._T.names.index(name)
        self.mesh = getattr(motion.system.body(name), "mesh", None)

    @property
    def r(self) -> Tensor:
        """Origin of the body frame in ground axes [lanes, times, 3] [m]."""
        return self.motion.coordinates(self._T.r_slice(self._index))[0]

    @property
    def p(self) -> Tensor:
        """Euler parameters [lanes, times, 4]."""
        return self.motion.coordinates(self._T.p_slice(self._index))[0]

    @property
    def A(self) -> Tensor:
        """Rotation, body -> ground [lanes, times, 3, 3]."""
        return rotation_matrix(self.p.movedim(-1, 0)).movedim((0, 1), (-2, -1))

    def _flexible(self) -> int:
        if self._index >= self._T.flexible:
            raise InputError(f"body {self.name!r} is rigid; allowed here: a flexible body")
        return self._index

    @property
    def w(self) -> Tensor:
        """Modal coordinates [lanes, times, modes]."""
        return self.motion.coordinates(self._T.w_slice(self._flexible()))[0]

    @property
    def dw_db(self) -> Tensor | None:
        """Sensitivities of the modal coordinates [lanes, times, modes, n_b]."""
        return self.motion.coordinates(self._T.w_slice(self._flexible()))[1]

    @property
    def wd(self) -> Tensor:
        """Rates of the modal coordinates [lanes, times, modes]."""
        index = torch.as_tensor(self._T.w_slice(self._flexible()), device=self.motion.v.device) - self._T.bodies
        return self.motion.v[..., index]

    @property
    def stiffness(self) -> tuple[Tensor, Tensor | None]:
        """Reduced stiffness Kr [lanes, m, m] and its design tangent [lanes, m, m, n_b]."""
        Kr = self.motion.dynamics.data["Kr"]
        m, f = self._T.own_modes[self._flexible()], self._index
        lanes = self.motion.q.shape[0]
        K = value(Kr)[:m, :m, f, 0].movedim(-1, 0).expand(lanes, m, m)
        if not isinstance(Kr, Pair):
            return K, None
        dK = Kr.tangent[:m, :m, f].movedim(-1, 0)
        return K, dK.expand(lanes, *dK.shape[1:])

    @property
    def strain_energy(self) -> Tensor:
        """U = 1/2 w' Kr w [lanes, times] [J]; eq. (17)."""
        return 0.5 * torch.einsum("lti,lij,ltj->lt", self.w, self.stiffness[0], self.w)

    @property
    def psi(self) -> Tensor:
        """Mode shapes [lanes, nodes, 6, modes] of the designs of this motion."""
        self._flexible()
        with torch.no_grad():
            psi = torch.func.functional_call(self.motion.system, self.motion.designs, (self.name,))["psi"]
        return psi if psi.dim() == 4 else psi[None].expand(self.motion.q.shape[0], *psi.shape)

    @property
    def displacements(self) -> Tensor:
        """Elastic displacements of the nodes in body axes [lanes, times, nodes, 3] [m]."""
        return torch.einsum("lnim,ltm->ltni", self.psi[:, :, :3], self.w)

    @property
    def nodes(self) -> Tensor:
        """Positions of the deformed mesh in ground axes [lanes, times, nodes, 3] [m]."""
        self._flexible()
        body = self.motion.system.body(self.name)
        local = body.mesh.nodes - body.origin + self.displacements
        return self.r[:, :, None] + torch.einsum("ltij,ltnj->ltni", self.A, local)
