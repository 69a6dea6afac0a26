"""The data of an exact beam under loads: tensors with or without leading lanes.

Axes: those of space are the axes of the mesh. The axes of a node coincide with them without load and turn with the node.
The end of an element has the axes of its section there, which turn with the node.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.math.vmap import batch_first


class BeamData(NamedTuple):
    """Tensors of a beam of n nodes and m elements and of its loads; each may have leading lanes.

    stiffness  of the elements: forces by screws (forces.py) [m, 6, 6]
    screws     of the elements without load: from the frame at the start to that at the end [m, 6]
    start, end axes of the sections at the ends of the elements in the axes of their nodes, columns [m, 3, 3]
    nodes      positions without load [n, 3], m
    dead       forces and moments that keep their directions, at the nodes [n, 6], N, N m
    arms       sum of arm times force over dead forces that act on arms [n, 3, 3], N m
    follower   forces and moments that turn with the nodes, in their axes [n, 6]
    mass, first, second   NodalMass (assemble.py) [n], [n, 3], [n, 3, 3]
    gravity    [3], m/s2
    spin, center  angular velocity [3], rad/s, about an axis through a point [3], m
    imposed    displacements and rotation vectors of held degrees of freedom [n, 6]
    free       change of the screws without load by temperature and moisture [m, 6]
    """

    stiffness: Float[Tensor, "*lanes m 6 6"]
    screws: Float[Tensor, "*lanes m 6"]
    start: Float[Tensor, "*lanes m 3 3"]
    end: Float[Tensor, "*lanes m 3 3"]
    nodes: Float[Tensor, "*lanes n 3"]
    dead: Float[Tensor, "*lanes n 6"]
    arms: Float[Tensor, "*lanes n 3 3"]
    follower: Float[Tensor, "*lanes n 6"]
    mass: Float[Tensor, "*lanes n"]
    first: Float[Tensor, "*lanes n 3"]
    second: Float[Tensor, "*lanes n 3 3"]
    gravity: Float[Tensor, "*lanes 3"]
    spin: Float[Tensor, "*lanes 3"]
    center: Float[Tensor, "*lanes 3"]
    imposed: Float[Tensor, "*lanes n 6"]
    free: Float[Tensor, "*lanes m 6"]

    @property
    def lanes(self) -> torch.Size:
        """Shape of the leading axes, broadcast over all fields."""
        return torch.Size(np.broadcast_shapes(*(x.shape[: x.dim() - k] for x, k in zip(self, RANKS, strict=True))))

    def split_lanes(self, lanes: torch.Size | None = None) -> list[BeamData]:
        """Return the data of each lane, expanded to `lanes` (default: its own)."""
        lanes = self.lanes if lanes is None else lanes
        cores = [x.shape[x.dim() - k :] for x, k in zip(self, RANKS, strict=True)]
        wide = [x.expand(*lanes, *core).reshape(-1, *core) for x, core in zip(self, cores, strict=True)]
        return [BeamData(*lane) for lane in zip(*wide, strict=True)]


#: Axes of each field besides lanes.
RANKS = (3, 2, 3, 3, 2, 2, 3, 2, 1, 2, 3, 1, 1, 1, 2, 2)


class Topology(NamedTuple):
    """Nodes of the elements [m, 2] and free degrees of freedom 6 * node + i [f]."""

    elements: Int[Tensor, "m 2"]
    free: Int[Tensor, " f"]
    symmetric: bool  # whether all loads have a potential


def batch_as_lane(
    size: int, in_dims: Sequence[int | None], tensors: Sequence[Tensor], ranks: Sequence[int]
) -> list[Tensor]:
    """Move the batch dimension of torch.func.vmap to the front of each tensor, and pad leading axes to the same number.

    in_dims  batch dimension of each tensor, or None
    ranks    number of its axes that are neither batch nor lanes
    """
    inner = max(x.dim() - (dim is not None) - k for x, dim, k in zip(tensors, in_dims, ranks, strict=True))
    wide = []
    for x, dim, k in zip(tensors, in_dims, ranks, strict=True):
        batch = batch_first(x, dim, size)
        missing = inner - (batch.dim() - 1 - k)
        wide.append(batch.reshape(len(batch), *(1,) * missing, *batch.shape[1:]))
    return wide
