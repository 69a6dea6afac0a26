"""Forces on nodes of a mesh from totals on node sets: spread as a uniform load on the cells or sides of the set.

A side t between i and j can bend to a parabola, (1/8) t x (phi_j - phi_i) at its middle: moments f x t / 12 at j, and
the opposite at i, do the work of a uniform load there.

Checked in tests/multibody/statics/test_buckling.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
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
        found = found + spread(mesh, nodes, total)
    return found


def spread(mesh: Mesh | BeamLine, nodes: Sequence[int], total: Float[Tensor, " c"]) -> Float[Tensor, "n 6"]:
    """A total of 3 or 6 numbers as a uniform load on the cells between these nodes, else on the sides or elements between
    them, with the moments that bend the ends of these; equal parts where nodes are of neither."""
    found = mesh.nodes.new_zeros(len(mesh.nodes), 6)
    weight = mesh.nodes.new_zeros(len(mesh.nodes))
    inside = torch.zeros(len(mesh.nodes), dtype=torch.bool)
    inside[list(nodes)] = True
    if not isinstance(mesh, BeamLine):
        for kind, corners in mesh.cells.items():
            own = inside[corners].all(1)
            area = mesh.areas[mesh.first(kind) : mesh.first(kind) + len(corners)][own] / corners.shape[1]
            weight.index_add_(0, corners[own].flatten(), area.repeat_interleave(corners.shape[1]))
    sides = torch.empty(0, 2, dtype=torch.long) if bool(weight.any()) else _sides(mesh, inside)
    along = mesh.nodes[sides[:, 1]] - mesh.nodes[sides[:, 0]]
    length = along.norm(dim=1)
    weight.index_add_(0, sides.flatten(), 0.5 * length.repeat_interleave(2))
    if bool((weight[list(nodes)] == 0.0).any()):
        weight, sides = inside.to(weight.dtype), sides[:0]
    found[:, : len(total)] = (weight / weight.sum())[:, None] * total
    if len(sides):
        force = (length / weight.sum())[:, None] * total[:3]
        bend = torch.linalg.cross(force, along) / 12.0
        found[:, 3:].index_add_(0, sides[:, 1], bend).index_add_(0, sides[:, 0], -bend)
    return found


def _sides(mesh: Mesh | BeamLine, inside: Tensor) -> Int[Tensor, "sides 2"]:
    """Sides of cells, or elements, between nodes inside."""
    if isinstance(mesh, BeamLine):
        pairs = mesh.elements
    else:
        pairs = torch.cat([torch.stack([c, c.roll(-1, 1)], -1).flatten(0, 1) for c in mesh.cells.values()])
    pairs = torch.unique(pairs.sort(1).values, dim=0)
    return pairs[inside[pairs].all(1)]
