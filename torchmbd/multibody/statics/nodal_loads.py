"""Forces on nodes of a mesh from totals on node sets: spread as a uniform load on the cells or sides of the set.

Checked in tests/multibody/statics/test_buckling.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine
from torchmbd.fem.mesh import Mesh
from torchmbd.math.owned import reals
from torchmbd.multibody.bodies.interpolation import node_indices

Loads = Mapping[Any, Sequence[float] | Tensor]


def nodal_forces(mesh: Mesh | BeamLine, name: str, loads: Loads) -> Float[Tensor, "n 6"]:
    """Forces [N] and moments [N m] on all nodes; loads: nodes -> total of 3 or 6 numbers."""
    if not isinstance(loads, Mapping):
        raise InputError(f"loads of {name!r} is {loads!r}; allowed: nodes -> force, or force and moment")
    found = torch.zeros(len(mesh.nodes), 6, dtype=torch.float64)
    for where, given in loads.items():
        total = reals(f"load {where!r} of {name!r}", given)
        if total.shape not in ((3,), (6,)) or not bool(torch.isfinite(total).all()):
            raise InputError(f"load {where!r} of {name!r} is {given!r}; allowed: 3 or 6 finite numbers")
        nodes = node_indices(mesh, list(where) if isinstance(where, tuple) else where)
        found[nodes, : len(total)] += shares(mesh, nodes)[:, None] * total
    return found


def shares(mesh: Mesh | BeamLine, nodes: Sequence[int]) -> Float[Tensor, " k"]:
    """What each of some nodes takes of a uniform load: by the areas of cells between them, else by lengths of sides; of
    nodes that share none of these, equal parts."""
    inside = torch.zeros(len(mesh.nodes), dtype=torch.bool)
    inside[list(nodes)] = True
    cells = [] if isinstance(mesh, BeamLine) else list(mesh.cells.values())
    sides = (
        [mesh.elements]
        if isinstance(mesh, BeamLine)
        else [torch.stack([c, c.roll(-1, 1)], -1).flatten(0, 1) for c in cells]
    )
    weight = mesh.nodes.new_zeros(len(mesh.nodes))
    if not isinstance(mesh, BeamLine):
        for kind, corners in mesh.cells.items():
            own = inside[corners].all(1)
            area = mesh.areas[mesh.first(kind) : mesh.first(kind) + len(corners)][own] / corners.shape[1]
            weight.index_add_(0, corners[own].flatten(), area.repeat_interleave(corners.shape[1]))
    if not bool(weight.any()):
        pairs = torch.unique(torch.cat(sides).sort(1).values, dim=0)
        pairs = pairs[inside[pairs].all(1)]
        half = 0.5 * (mesh.nodes[pairs[:, 1]] - mesh.nodes[pairs[:, 0]]).norm(dim=1)
        weight.index_add_(0, pairs.flatten(), half.repeat_interleave(2))
    own = weight[list(nodes)]
    return torch.full_like(own, 1.0 / len(own)) if bool((own == 0.0).any()) else own / own.sum()
