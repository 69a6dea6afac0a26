"""The size of a mechanism, and the sizes of its constraint rows and rates: numbers with units are divided by them.

    L     size: twice the distance of the farthest point from the mean of all points [m]
    rho   size of a row: L where the row is a length, 1 where it is an angle or a cosine; of a relation sum c_i x_i the largest
          |c_i| of its angles and |c_i| L of its travels
    s     size of a rate: L of the velocity of a point, 1 of an angular velocity and of a modal rate

Phi / rho and v / s do not depend on the unit of length, so that least squares and limits of them do not either. L is that of
the model as it was built: it has no derivatives, and it is the same for all designs of a batch.
Checked in tests/physics/test_units_of_systems.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.multibody.equations.topology import Topology


def extent(points: Tensor) -> Tensor:
    """L of the module header [lanes] of points [3, n, lanes]."""
    return 2.0 * (points - points.mean(1, keepdim=True)).norm(dim=0).amax(0)


def row_sizes(T: Topology, size: float) -> Tensor:
    """rho of the module header [rows]."""
    parts = [torch.zeros(0, dtype=torch.float64)]
    for primitive, _ in T.row_slices():
        parts.append(primitive.sizes(size).repeat(primitive.rows))
    return torch.cat(parts)


def rate_sizes(T: Topology, size: float) -> Tensor:
    """s of the module header [n_v], of a topology whose rates are those of bodies."""
    result = torch.ones(T.n_v, dtype=torch.float64)
    result[: 3 * T.bodies] = size
    return result
