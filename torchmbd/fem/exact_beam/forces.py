"""Forces of an exact beam: of its elements, which are screws between two frames, and of its loads.

    l = log(H_1^-1 H_2),    f = (h S)^-1 (l - l_0 - factor h e),    work: f' dl

H_1, H_2   frames of the sections at the ends, in space
l, l_0     screws from the first to the second, in its axes, under load and without (math/rigid_motion.py)
h S        compliance of the sections times the length: strains are constant along the element, in the axes of the section
e          free strains of the sections by temperature and moisture, which grow with the factor of the loads

Rotations enter by relative motions alone: rigid motions of any size leave l as it is (objective), rotations are matrices
(no singularity), and an element that bends into an arc or a helix is exact: one element rolls up to a circle, nothing
locks. Elsewhere displacements converge with h^2.

A uniform dead load q on a length h acts as h q / 2 at both ends, on arms h / 6 along the tangent: the work of q on Hermite's
cubic between the nodes. Particles of mass feel gravity and, in a frame that spins, -spin x (spin x (place - center)).
Source: J. C. Simo, L. Vu-Quoc, A three-dimensional finite-strain rod model II, Comput. Methods Appl. Mech. Eng. 58 (1986)
79-116; V. Sonneville, A. Cardona, O. Bruls, ibid. 268 (2014) 451-474.
Checked in tests/fem/exact_beam/test_forces.py.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.exact_beam.data import BeamData, Topology
from torchmbd.math.rigid_motion import end_map, end_wrenches, hat, logarithm, wrench_slopes

# The permutation symbol: eps_ijk a_j b_k = a cross b
_PERMUTATION = torch.zeros(3, 3, 3, dtype=torch.float64)
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _PERMUTATION[_i, _j, _k], _PERMUTATION[_i, _k, _j] = 1.0, -1.0


def curl(Y: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """Return eps_ijk Y_jk: a cross b of Y = a b'."""
    return torch.einsum("ijk,...jk->...i", _PERMUTATION, Y)


def rotated(R: Float[Tensor, "*n 3 3"], by: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Rotate R by the small rotation vectors `by` [rad] in space: the first derivative at by = 0 is exact."""
    return R + hat(by) @ R


def screws(data: BeamData, topology: Topology, x: Tensor, R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Screws l of the elements [*lanes, m, 6], and axes of their ends in space [*lanes, m, 3, 3]."""
    i, j = topology.elements.unbind(1)
    first, second = R[..., i, :, :] @ data.start, R[..., j, :, :] @ data.end
    return _screw(x[..., j, :] - x[..., i, :], first, second), first, second


def element_wrenches(data: BeamData, topology: Topology, x: Tensor, R: Tensor) -> Float[Tensor, "*lanes m 2 6"]:
    """Forces and moments on both ends of the elements under all loads, in the axes of their sections."""
    screw, _, _ = screws(data, topology, x, R)
    return torch.stack(end_wrenches(screw, _screw_force(data, screw, 1.0)), -2)


def element_forces(
    data: BeamData, topology: Topology, x: Tensor, R: Tensor, factor: Tensor | float = 1.0
) -> Float[Tensor, "*lanes m 12"]:
    """Forces and moments on both ends of the elements, in space."""
    screw, first, second = screws(data, topology, x, R)
    return _in_space(screw, _screw_force(data, screw, factor), first, second)


def load_forces(data: BeamData, x: Tensor, R: Tensor, factor: Tensor | float) -> Float[Tensor, "*lanes n 6"]:
    """Forces and moments of the loads at the nodes, times `factor`; centrifugal ones, too, so the spin grows with its root."""
    W = hat(data.spin) @ hat(data.spin)
    first = (R @ data.first[..., None])[..., 0]
    field = data.gravity[..., None, :] - (x - data.center[..., None, :]) @ W  # W is symmetric
    force = data.dead[..., :3] + (R @ data.follower[..., :3, None])[..., 0]
    force = force + data.mass[..., None] * field - first @ W
    second = R @ data.second @ R.mT @ W[..., None, :, :]
    moment = data.dead[..., 3:] + (R @ data.follower[..., 3:, None])[..., 0] + curl(R @ data.arms - second)
    return factor * torch.cat([force, moment + torch.linalg.cross(first, field)], -1)


def residual(data: BeamData, topology: Topology, x: Tensor, R: Tensor, factor: Tensor | float = 1.0) -> Tensor:
    """Unbalanced forces and moments at the nodes, loads less element forces [*lanes, n, 6]."""
    outer = load_forces(data, x, R, factor)
    ends = element_forces(data, topology, x, R, factor).unflatten(-1, (2, 6)).flatten(-3, -2)
    lanes = np.broadcast_shapes(outer.shape[:-2], ends.shape[:-2])
    return outer.expand(*lanes, -1, -1).index_add(-2, topology.elements.flatten(), -ends.expand(*lanes, -1, -1))


def screw_forces(
    data: BeamData, topology: Topology, x: Tensor, R: Tensor, factor: Tensor | float = 1.0
) -> Float[Tensor, "*lanes m 6"]:
    """Forces f of the elements, conjugate to their screws l (module header)."""
    return _screw_force(data, screws(data, topology, x, R)[0], factor)


def element_tangents(
    data: BeamData, topology: Topology, x: Tensor, R: Tensor, f: Tensor
) -> tuple[Float[Tensor, "m 12 12"], Float[Tensor, "m 6 12"]]:
    """Return the stiffness of the elements under forces f by motions of their nodes in space, and the derivative of f."""
    screw, first, second = screws(data, topology, x, R)
    o = torch.zeros_like(first)
    turn = torch.cat([torch.cat([first, o, o, o], -1), torch.cat([o, first, o, o], -1)], -2)
    turn = torch.cat([turn, torch.cat([torch.cat([o, o, second, o], -1), torch.cat([o, o, o, second], -1)], -2)], -2)
    B = torch.cat([-end_map(-screw), end_map(screw)], -1) @ turn.mT
    wrenches = torch.cat(end_wrenches(screw, f), -1)
    F, M, G, N = (turn @ wrenches[..., None])[..., 0].split(3, -1)
    K = turn @ wrench_slopes(screw, f) @ B + B.mT @ data.stiffness @ B
    spin = torch.zeros_like(K)  # forces turn with the ends
    for rows, cols, x in ((0, 3, F), (3, 3, M), (6, 9, G), (9, 9, N)):
        spin[..., rows : rows + 3, cols : cols + 3] = -hat(x)
    return K + spin, data.stiffness @ B


def load_tangents(data: BeamData, x: Tensor, R: Tensor, factor: float) -> Float[Tensor, "n 6 6"]:
    """Minus the derivatives of `load_forces` by displacements and rotations of the nodes."""
    W = hat(data.spin) @ hat(data.spin)
    first = hat((R @ data.first[..., None])[..., 0])
    field = hat(data.gravity[..., None, :] - (x - data.center[..., None, :]) @ W)
    force, moment = (hat((R @ v[..., None])[..., 0]) for v in data.follower.split(3, -1))
    second = R @ data.second @ R.mT
    E = hat(torch.eye(3, dtype=torch.float64))  # [axis, 3, 3]
    rotated_second = E @ second[..., None, :, :] + second[..., None, :, :] @ E.mT
    couples = curl(E @ (R @ data.arms)[..., None, :, :] - rotated_second @ W).mT
    upper = torch.cat([data.mass[..., None, None] * W, force - W @ first], -1)
    lower = torch.cat([first @ W, moment - couples - field @ first], -1)
    return factor * torch.cat([upper, lower], -2)


def _screw(apart: Tensor, first: Tensor, second: Tensor) -> Tensor:
    return logarithm((first.mT @ apart[..., None])[..., 0], first.mT @ second)


def _screw_force(data: BeamData, screw: Tensor, factor: Tensor | float) -> Tensor:
    return (data.stiffness @ (screw - data.screws - factor * data.free)[..., None])[..., 0]


def _in_space(screw: Tensor, f: Tensor, first: Tensor, second: Tensor) -> Tensor:
    pairs = zip((first, second), end_wrenches(screw, f), strict=True)
    return torch.cat([(A @ w.unflatten(-1, (2, 3)).mT).mT.flatten(-2) for A, w in pairs], -1)
