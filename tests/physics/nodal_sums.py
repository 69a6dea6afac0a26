"""Energy and momentum of a motion as sums over nodes and rigid bodies, without inertia invariants.

A node at x in the body frame, with shapes t, r, moves with  r' + A (om x (x + t w) + t w')  and turns with  om + r w'.
Rotary inertia of a node is isotropic. Rigid bodies enter with their inertia about the center of mass.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tests.mechanisms import cross_matrix
from torchmbd.integrate import Trajectory


@dataclass
class Sums:
    """One lane at every time: energies [times] [J], momentum and its moment about the ground's origin [times, 3]."""

    kinetic: Tensor
    strain: Tensor
    potential: Tensor
    momentum: Tensor
    moment: Tensor

    @property
    def energy(self) -> Tensor:
        return self.kinetic + self.strain + self.potential

    def __add__(self, other: Sums) -> Sums:
        return Sums(*(getattr(self, name) + getattr(other, name) for name in Sums.__dataclass_fields__))


def sums(motion: Trajectory, lane: int = 0) -> Sums:
    """Over all bodies."""
    T = motion.dynamics.topology
    parts = [(_flexible if i < T.flexible else _rigid)(motion, i, lane) for i in range(len(T.names))]
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def rates(motion: Trajectory, index: int, lane: int) -> tuple[Tensor, Tensor]:
    """Velocity of the origin in ground axes and angular velocity in body axes [times, 3]."""
    n, v = motion.dynamics.topology.bodies, motion.v[lane]
    return v[:, [i * n + index for i in range(3)]], v[:, [(3 + i) * n + index for i in range(3)]]


def _gravity(motion: Trajectory) -> Tensor:
    g = motion.system.gravity
    return torch.zeros(3, dtype=torch.float64) if g is None else g


def _flexible(motion: Trajectory, index: int, lane: int) -> Sums:
    name = motion.dynamics.topology.names[index]
    view, body = motion.body(name), motion.system.body(name)
    mass = (body.laminate.mass_per_area * body.matrices.area).detach()
    rotary = (body.laminate.rotary_inertia_per_area * body.matrices.area).detach()
    psi, A, w, wd = view.psi[lane], view.A[lane], view.w[lane], view.wd[lane]
    velocity, om = rates(motion, index, lane)
    local = body.mesh.nodes - body.origin + torch.einsum("nim,tm->tni", psi[:, :3], w)
    drift = torch.linalg.cross(om[:, None].expand_as(local), local) + torch.einsum("nim,tm->tni", psi[:, :3], wd)
    v = velocity[:, None] + torch.einsum("tij,tnj->tni", A, drift)
    x = view.r[lane][:, None] + torch.einsum("tij,tnj->tni", A, local)
    turn = om[:, None] + torch.einsum("nim,tm->tni", psi[:, 3:], wd)
    spin = torch.einsum("tij,tj->ti", A, torch.einsum("n,tni->ti", rotary, turn))
    return Sums(
        kinetic=0.5 * torch.einsum("n,tni->t", mass, v * v) + 0.5 * torch.einsum("n,tni->t", rotary, turn * turn),
        strain=view.strain_energy[lane],
        potential=-torch.einsum("n,tni,i->t", mass, x, _gravity(motion)),
        momentum=torch.einsum("n,tni->ti", mass, v),
        moment=torch.einsum("n,tni->ti", mass, torch.linalg.cross(x, v)) + spin,
    )


def _rigid(motion: Trajectory, index: int, lane: int) -> Sums:
    name = motion.dynamics.topology.names[index]
    view, body = motion.body(name), motion.system.body(name)
    inertia = body.second_moment.trace() * torch.eye(3, dtype=torch.float64) - body.second_moment
    A, (velocity, om) = view.A[lane], rates(motion, index, lane)
    c = torch.stack([a @ body.center for a in A])
    v = velocity + torch.stack([a @ cross_matrix(o) @ body.center for a, o in zip(A, om, strict=True)])
    x = view.r[lane] + c
    spin = om @ inertia
    return Sums(
        kinetic=0.5 * body.mass * (v * v).sum(1) + 0.5 * (om * spin).sum(1),
        strain=torch.zeros(len(v), dtype=torch.float64),
        potential=-body.mass * (x @ _gravity(motion)),
        momentum=body.mass * v,
        moment=body.mass * torch.linalg.cross(x, v) + torch.einsum("tij,tj->ti", A, spin),
    )
