"""The size of a mechanism, and the sizes of its constraint rows and rates: numbers with units are divided by them.

    rho   size of a row: L where the row is a length, 1 where it is an angle or a cosine; of a relation sum c_i x_i the root of
          the sum of squares of c_i of its angles and c_i L of its travels
    s     size of a rate: L of the velocity of a point, 1 of an angular velocity; L sqrt(m) of the rates of modes, which have
          unit modal mass, in a body of mass m where these are compared with others

Phi / rho and v / s do not depend on the unit of length, so that least squares and limits of them do not either. L has two
kinds:

    built   twice the distance of the farthest point from the mean of all points of the model as it was built [m]: for limits
    size_at twice the root mean square of these distances at a position [m], with its derivatives: for least squares, whose
            results depend on it. A design of a batch has the results of a system that is built with it

The unknowns of a step are compared by their sizes: s of accelerations, m L^2 / rho of multipliers, with the largest mass m of a
body. So all of them become numbers in 1/s^2, and cotangents of both kinds have one unit too.

A joint is closed where |Phi| is less than 1e-11 rho, and a small multiple of what the rounding of positions makes of it.
Checked in tests/physics/test_units_of_systems.py, tests/sensitivity/test_node_variables.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.elementwise import sqrt
from torchmbd.math.pair import cat, dot, linear, value
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.equations import Placement, split_q
from torchmbd.multibody.equations.topology import Topology

_CLOSED = 1e-11  # share of the size of a row: largest violation of a closed joint
_ROUNDING = 1e-14  # share of the distance from the origin of ground: the same, by rounding of positions


def extent(points: Tensor) -> Tensor:
    """Twice the distance of the farthest of points [3, n, lanes] from their mean [lanes]."""
    return 2.0 * (points - points.mean(1, keepdim=True)).norm(dim=0).amax(0)


def size_at(T: Topology, q: Any, at: Placement) -> Any:
    """L at coordinates q [n_q, ...], whose placement is `at` [...] of the module header; 1 m where all points coincide."""
    is_point = torch.tensor([i for i, x in enumerate(T.attached) if x.is_point], dtype=torch.long)
    points = cat([split_q(T, q)[0], linear(lambda x: x.index_select(1, is_point), at.g)], 1)
    ways = points - linear(lambda x: x.mean(1, keepdim=True), points)
    square = linear(lambda x: 4.0 * x.mean(0), dot(ways, ways))
    return sqrt(square + (value(square) == 0.0).double())


def row_sizes(T: Topology, size: Any, data: Data | None = None) -> Any:
    """rho of the module header [rows, ...] for a size [...] [m], or a float; data: of a design, None: the model as it was
    built."""
    size = torch.full((1, 1), size, dtype=torch.float64) if isinstance(size, float) else size
    parts = [linear(lambda x: x[None][:0], size)]
    for primitive, _ in T.row_slices():
        of_one = primitive.sizes(size, data)
        parts += [of_one] * primitive.rows
    return cat(parts)


def closed_rows(T: Topology, size: float, q: Tensor) -> Tensor:
    """Largest violations [rows, 1, 1] of closed joints at coordinates q [n_q, ...]; size: as built [m]."""
    far = float(q[: 3 * T.bodies].abs().max())
    return row_sizes(T, size) * (_CLOSED + _ROUNDING * far / size)


def rate_sizes_at(T: Topology, size: Any) -> Any:
    """s [n_v, ...] of a size [...] with derivatives; modal rates are compared among each other only."""
    points = torch.zeros(T.n_v, 1, 1, dtype=torch.float64)
    points[: 3 * T.bodies] = 1.0
    return linear(lambda x: points * x, size) + (1.0 - points)


def rate_sizes(T: Topology, size: float, mass: Tensor) -> Tensor:
    """s of the module header [n_v, ...], of bodies with masses [bodies, ...]; size: as built [m]."""
    return _size_of_kinds(T, size, mass)[T.rate_kinds]


class Sizes(NamedTuple):
    """Sizes of coordinates [n_q, lanes], of rates [n_v, lanes], and of accelerations above multipliers [n_v + rows, lanes]."""

    q: Tensor
    v: Tensor
    unknowns: Tensor

    @classmethod
    def of(cls, T: Topology, size: float, mass: Tensor) -> Sizes:
        """The sizes in a mechanism of a size [m], as built, whose bodies have masses [bodies, lanes] [kg]."""
        of_kinds = _size_of_kinds(T, size, mass)
        v = of_kinds[T.rate_kinds]
        multipliers = size**2 * mass.amax(0) / row_sizes(T, size)[:, 0]
        return cls(of_kinds[T.coordinate_kinds], v, torch.cat([v, multipliers]))


def _size_of_kinds(T: Topology, size: float, mass: Tensor) -> Tensor:
    """Sizes [2 + flexible, ...] of an angle, of a way, and of modal coordinates of each flexible body: `T.rate_kinds`."""
    of_modes = size * mass[: T.flexible].clamp_min(0.0).sqrt()
    return torch.cat([torch.full_like(mass[:1], 1.0), torch.full_like(mass[:1], size), of_modes])
