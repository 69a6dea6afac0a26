"""Displacements of second order of a flexible body: what stiffens it where it spins, or where joints pull at it.

    u = t w + 1/2 w' f w          displacement of a point;   f: shortening of a line that bends, symmetric [modes, modes]

The work of forces p on f is that of the geometric stiffness under their static stress, p . f = -Psi' Kg(K^-1 p) Psi, with the
body held at its reference. So f need not be known point by point: sums over the mass points follow from twelve unit loads of
inertia, and f of a node from six unit loads on it.

    F1_i  = sum m f_i        p = -m e_i                  acceleration along axis i
    F2_ij = sum m f_i x_j    p = -m e_i x_j              acceleration Z = e_i e_j': products of angular velocities (symmetric
                                                         part) and angular accelerations (antisymmetric, with rotary inertia)
    f, g                     p = e_i, moment e_i         on a node: displacement and rotation vector

A mass point on an arm d moves by 1/2 phi x (phi x d) besides, phi: rotation of its node.
Computed with the design, forward and reverse, from the unit loads alone: no step depends on the mesh.
Assumed: stress of the undeformed body; arms of rigid links and averages turn linearly.
Source: T. R. Kane, R. R. Ryan, A. K. Banerjee, J. Guid. Control Dyn. 10 (1987) 139-151; O. Wallrapp and R. Schwertassek, Int.
J. Numer. Methods Eng. 32 (1991) 1833-1850 (geometric stiffness of unit loads).
Checked in tests/multibody/bodies/test_stiffening.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements import Assembly, GivenElements, MassPoints
from torchmbd.fem.elements.geometric import projected_geometric_stiffness
from torchmbd.fem.reduction import StaticLoads
from torchmbd.math.module_call import outside_transforms
from torchmbd.math.sparse import SparseMatrix

INERTIAL = 12  # unit loads of inertia


def check_stressed(name: str, what: str, parts: Mapping[str, Any]) -> None:
    """InputError for parts whose stress is not known."""
    for part_name, part in parts.items():
        if isinstance(part, GivenElements):
            raise InputError(
                (name, part_name),
                allowed=f"plates or beams, for {what}",
                state="has rods, springs or solids, whose stress torchmbd does not compute",
                noun=f"part {part_name!r} of {name!r}",
            )


class Stiffening:
    """Displacements of second order of one body: its assembly with the reference held."""

    def __init__(self, name: str, assembly: Assembly) -> None:
        check_stressed(name, "stiffening", assembly.parts)
        self.name, self.assembly = name, assembly
        self._static = outside_transforms(lambda: StaticLoads(assembly.pattern))

    def __call__(
        self,
        K: SparseMatrix,
        points: MassPoints,
        x: Float[Tensor, "*lanes points 3"],
        psi: Tensor,
        nodes: Sequence[int],
    ) -> dict[str, Tensor]:
        """F1 [..., 3, m, m], F2 [..., 3, 3, m, m], and "psi2" [..., nodes, 6, m, m], f and g of the nodes that are asked for.

        K     stiffness of the free degrees of freedom
        x     places of the mass points from the origin of the body
        psi   modes at the nodes [..., n, 6, m]
        """
        loads = inertial_loads(points, x)
        forces = self.assembly.freedoms.gathered(self.assembly.forces_on_nodes(loads, points.arm))
        if nodes:
            unit = forces.new_zeros(6 * len(self.assembly.mesh.nodes), 6 * len(nodes))
            for k, node in enumerate(nodes):
                unit[6 * node : 6 * node + 6, 6 * k : 6 * k + 6] = torch.eye(6, dtype=forces.dtype)
            node_forces = self.assembly.freedoms.gathered(unit.unflatten(0, (-1, 6)))
            forces = torch.cat([forces, node_forces.expand(*forces.shape[:-2], *node_forces.shape)], -1)
        u = self.assembly.freedoms.expand(self._static(K, forces))
        Kg = projected_geometric_stiffness(self.assembly.stressed(u), psi)
        turned = _turned_arms(points, x, self.assembly.mass_motion(psi, points.arm)[..., 3:, :])
        inertial = Kg[..., :INERTIAL, :, :].unflatten(-3, (4, 3))
        inertial = inertial if turned is None else inertial + turned
        F1, F2 = inertial[..., 0, :, :, :], inertial[..., 1:, :, :, :].transpose(-4, -3)
        return {"F1": F1, "F2": F2, "psi2": -Kg[..., INERTIAL:, :, :].unflatten(-3, (len(nodes), 6))}


def _weights(points: MassPoints, x: Tensor) -> Float[Tensor, "*lanes points 4"]:
    """m and m x_j."""
    ones = torch.ones_like(x[..., :1])
    return points.mass[..., None] * torch.cat([ones, x], -1)


def inertial_loads(points: MassPoints, x: Tensor) -> Float[Tensor, "*lanes points 6 12"]:
    """Unit loads: along i of weight 1, x_1, x_2, x_3, in this order of columns (weight, i)."""
    weights, eye = _weights(points, x), torch.eye(3, dtype=x.dtype)
    force = -(weights[..., None, :, None] * eye[:, None, :]).flatten(-2)
    # Z = e_i e_j' has the angular acceleration 1/2 e_j x e_i.
    spin = 0.5 * torch.linalg.cross(eye[:, None].expand(3, 3, 3), eye[None].expand(3, 3, 3), dim=-1)  # [j, i, 3]
    spin = torch.cat([torch.zeros(3, 3, dtype=x.dtype), spin.flatten(0, 1).T], -1)
    moment = -points.rotary[..., None, None] * spin
    lanes = np.broadcast_shapes(force.shape[:-2], moment.shape[:-2])
    return torch.cat([force.expand(*lanes, 3, INERTIAL), moment.expand(*lanes, 3, INERTIAL)], -2)


def turned_arm(phi: Float[Tensor, "*lanes 3 m"], arm: Float[Tensor, "*lanes 3"]) -> Float[Tensor, "*lanes 3 m m"]:
    """s of phi x (phi x arm) = w' s w for the rotation phi w."""
    along = (phi * arm[..., :, None]).sum(-2)  # [..., m]
    both = phi[..., :, :, None] * along[..., None, None, :]
    across = (phi.mT @ phi)[..., None, :, :] * arm[..., :, None, None]
    return 0.5 * (both + both.mT) - across


def _turned_arms(points: MassPoints, x: Tensor, phi: Float[Tensor, "*lanes points 3 m"]) -> Tensor | None:
    """Sums of the weights times `turned_arm` over the mass points [..., 4, 3, m, m]; None without arms."""
    if points.arm is None:
        return None
    weights, sums = _weights(points, x), []
    along = (phi * points.arm[..., :, None]).sum(-2)
    for k in range(4):
        w = weights[..., k]
        both = torch.einsum("...pia,...pb->...iab", phi * w[..., None, None], along)
        scaled = points.arm * w[..., None]
        across = torch.stack(
            [torch.einsum("...p,...pka,...pkb->...ab", scaled[..., i], phi, phi) for i in range(3)], -3
        )
        sums.append(0.5 * (both + both.mT) - across)
    return torch.stack(sums, -4)
