"""Bodies that beam elements join, moved together: the joints of exact beams close without straining them where they can.

    r_i <- c + V + exp(th) (r_i - c),   A_i <- exp(th) A_i       y = (V, th) of each group in ground axes, c: mean of its r_i

    y = -J~+ Phi,   J~ = Phi_q R,   R = dq/dy at y = 0
    dy = -J~+ (dPhi + dJ~ y) + (1 - J~+ J~) dJ~' J~+' y          by the design, as in initial.py

Rows are divided by their sizes, and V by the size of the mechanism (equations/sizes.py).

A body without elements is a group of its own; a group that elements tie to the ground cannot move.
Checked in tests/multibody/start/test_rigid_groups.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.gradients import untransformed
from torchmbd.math.pair import apply, cat, cross, linear, matvec, matvec_t, value
from torchmbd.math.rotation import exponential, quaternion_product, rotation_matrix
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.sizes import row_sizes, size_at
from torchmbd.multibody.equations.topology import Topology

_STEPS = 50
_RANK = 1e-10  # as in initial.py
_SLOW = 0.5  # factor of the violation of a step after which groups have done what they can


@dataclass(frozen=True, eq=False)
class RigidGroups:
    """of: group of each moving body [bodies]; mean [groups, bodies]: weights of the means of their origins."""

    topology: Topology
    of: Tensor
    mean: Tensor
    free: Tensor  # 1 for groups that can move, else 0 [groups]

    @classmethod
    def by_beams(cls, T: Topology) -> RigidGroups:
        """The groups of a system with beam elements."""
        assert T.beams is not None
        group, n = [*range(T.bodies), -1], len(T.beams.bodies) // 2
        for first, second in zip(T.beams.bodies[:n], T.beams.bodies[n:], strict=True):
            first, second = (group[min(k, T.bodies)] for k in (first, second))
            group = [min(first, second) if k in (first, second) else k for k in group]
        of_ground = group.pop()
        names = sorted(set(group))
        of = torch.tensor([names.index(k) for k in group])
        members = torch.nn.functional.one_hot(of, len(names)).T.double()
        free = torch.tensor([float(k != of_ground) for k in names], dtype=torch.float64)
        return cls(T, of, members / members.sum(1, keepdim=True), free)

    def closed(self, dynamics: Any, q: Any, t: Tensor, small: Tensor) -> Any:
        """Coordinates [n_q, pair, lanes] with the joints closed as far as groups can; small: violations of closed ones [rows,
        1, 1]."""
        before = torch.inf
        for _ in range(_STEPS):
            q, violation = self._step(dynamics, q, t, small)
            if violation <= 1.0 or not violation < _SLOW * before:
                return q
            before = violation
        return q

    def _step(self, dynamics: Any, q: Any, t: Tensor, small: Tensor) -> tuple[Any, float]:
        """q after a step, and the largest violation before it, as a multiple of `small`."""
        T, data = self.topology, dynamics.data
        values = {name: value(x).detach() for name, x in data.items()}
        plain = equations.placement(T, values, value(q).detach(), T.prescribed(t, values))
        at = equations.placement(T, data, q, T.prescribed(t, data))
        J = dynamics.saddle.jacobian(values, plain)[:, :, : 6 * T.bodies]
        unit = torch.eye(6 * len(self.free), dtype=torch.float64)[..., None] * self.free.repeat(6)[:, None, None]
        R = self._rates(value(q).detach(), unit.expand(-1, -1, J.shape[0]))[: 6 * T.bodies].permute(2, 0, 1)
        n, size = 3 * len(self.free), size_at(T, q, at)
        moves = torch.tensor([1.0] * n + [0.0] * n, dtype=torch.float64)[:, None, None]
        s, rho = linear(lambda x: moves * x, size) + (1.0 - moves), row_sizes(T, value(size).detach(), values)
        J = (J @ R) * value(s).detach().permute(2, 1, 0) / rho.permute(2, 0, 1)  # [lanes, rows, 6 groups]
        U, sigma, Vh = torch.linalg.svd(J, full_matrices=False)
        inverse = Vh.mT @ (torch.where(sigma > _RANK * sigma[:, :1], 1.0 / sigma, 0.0)[..., None] * U.mT)
        phi = equations.constraints(T, at)
        y = -apply(inverse, value(phi).detach() / rho)  # divided by s
        residual = phi + equations.constraint_changes(T, at, data, self._rates(q, s * y))
        forces = s * self._forces(q, equations.constraint_forces(T, data, at, apply(inverse.mT, y) / rho))
        turned = linear(lambda u: u - apply(inverse, apply(J, u)), forces)
        y = y + (turned - value(turned).detach()) - linear(lambda x: apply(inverse, x / rho), residual)
        return self._moved(q, s * y), float((untransformed(value(phi)).abs() / small).max())

    def _arms(self, q: Any) -> tuple[Any, Any, Any]:
        """Centers of the groups of all bodies, origins from these [3, bodies, ...] and Euler parameters."""
        r, p, _ = equations.split_q(self.topology, q)
        mean = self.mean[self.of]
        center = linear(lambda x: torch.einsum("bk,ik...->ib...", mean, x), r)
        return center, r - center, p

    def _rates(self, q: Any, y: Any) -> Any:
        """R y [n_v, ...] of y [6 groups, ...]."""
        V, th = self._on_bodies(y)
        _, arm, p = self._arms(q)
        rates = cat([(V + cross(th, arm)).flatten(0, 1), matvec_t(rotation_matrix(p), th).flatten(0, 1)])
        missing = self.topology.n_v - 6 * self.topology.bodies
        return cat([rates, linear(lambda x: x.new_zeros(missing, *x.shape[1:]), rates)])

    def _forces(self, q: Any, forces: tuple[Any, Any, Any]) -> Any:
        """R' f [6 groups, ...] of forces in ground axes and torques in body axes."""
        force, torque, _ = forces
        _, arm, p = self._arms(q)
        moment = cross(arm, force) + matvec(rotation_matrix(p), torque)
        members = (self.mean > 0.0).double() * self.free[:, None]
        sums = [linear(lambda x: torch.einsum("gk,ik...->ig...", members, x), x).flatten(0, 1) for x in (force, moment)]
        return cat(sums)

    def _on_bodies(self, y: Any) -> tuple[Any, Any]:
        n = len(self.free)
        return tuple(x.unflatten(0, (3, n)).index_select(1, self.of) for x in (y[: 3 * n], y[3 * n :]))

    def _moved(self, q: Any, y: Any) -> Any:
        """q after the finite motion of the groups."""
        V, th = self._on_bodies(y)
        center, arm, p = self._arms(q)
        turn = exponential(th)
        r = center + V + matvec(rotation_matrix(turn), arm)
        return cat([r.flatten(0, 1), quaternion_product(turn, p).flatten(0, 1), q[7 * self.topology.bodies :]])
