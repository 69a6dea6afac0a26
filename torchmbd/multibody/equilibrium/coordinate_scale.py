"""Sizes of the coordinates of a mechanism: numbers with units that are compared are first divided by them.

    L    size of the mechanism: twice the distance of the farthest point from the mean of all points [m]
    s    L for displacements of bodies, 1 rad for their rotations, L sqrt(m) for modal coordinates of unit modal mass

Points are the origins of bodies and the points of joints and forces. A body is at least as large as its radius of gyration.
Forces times s are works, and increments of coordinates divided by s are numbers without units. Limits and ranks that are
stated for them are the same for a mechanism in another system of units, at another place or in another direction, and for
one of another size of the same materials.
Checked in tests/multibody/equilibrium/test_scales.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.equations import Placement
from torchmbd.multibody.equations.sizes import extent
from torchmbd.multibody.equations.topology import Topology


def coordinate_scale(T: Topology, data: Data, at: Placement, q: Tensor) -> Tensor:
    """s of the module header [n_v, lanes] at coordinates q [n_q, 1, lanes], whose placement is `at`; data are values."""
    n, lanes = T.bodies, q.shape[-1]
    mass = data["mass"][:n, 0].expand(n, lanes)
    size = _size(T, data, at, q, mass)
    modal = (size * mass[: T.flexible].clamp_min(0.0).sqrt()).expand(T.modes, -1, -1).flatten(0, 1)
    return torch.cat([size.expand(3 * n, -1), torch.ones_like(size).expand(3 * n, -1), modal])


def _size(T: Topology, data: Data, at: Placement, q: Tensor, mass: Tensor) -> Tensor:
    """L of the module header [lanes]; 1 m for a mechanism without extent."""
    n, lanes = T.bodies, q.shape[-1]
    is_point = torch.tensor([x.is_point for x in T.attached], dtype=torch.bool)
    points = torch.cat([q[: 3 * n, 0].reshape(3, n, lanes), at.g[:, is_point, 0].expand(-1, -1, lanes)], 1)
    moment = data["P0"][:, :, :n, 0].diagonal(dim1=0, dim2=1).sum(-1)  # integral of x . x dm
    gyration = (moment.clamp_min(0.0) / mass).sqrt().amax(0)
    size = torch.maximum(extent(points), gyration)
    return torch.where(size > 0.0, size, 1.0)
