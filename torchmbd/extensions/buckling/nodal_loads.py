"""Forces on nodes of a mesh from total loads on node sets, spread as a uniform load on the cells or sides of the set.

A side t between i and j may bend to a parabola with the deflection (1/8) t x (phi_j - phi_i) at its middle: moments f x t / 12
at j, and the opposite at i, do the work of a uniform load on it.

Checked in tests/extensions/buckling/test_buckling.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine
from torchmbd.fem.elements.beam_line import present_nodes
from torchmbd.fem.mesh import Mesh
from torchmbd.math.checked_numbers import reals
from torchmbd.multibody.bodies.interpolation import node_indices

Loads = Mapping[Any, Sequence[float] | Tensor]


class NodalLoads:
    """Total loads on nodes of a mesh, checked: nodes -> 3 or 6 numbers."""

    def __init__(self, mesh: Mesh | BeamLine, name: str, loads: Loads) -> None:
        if not isinstance(loads, Mapping):
            raise InputError((name, "loads"), loads, "a mapping node -> force, or force and moment")
        self.mesh, self.any = mesh, False
        self._loads: list[tuple[list[int], Tensor]] = []
        for where, load in loads.items():
            total = reals(f"load {where!r} of {name!r}", load)
            if total.shape not in ((3,), (6,)) or not bool(torch.isfinite(total).all()):
                raise InputError(
                    (name, "loads", str(where)), load, "3 or 6 finite numbers", noun=f"load {where!r} of {name!r}"
                )
            nodes = node_indices(mesh, list(where) if isinstance(where, tuple) else where)
            self._loads.append((list(nodes), total))
            self.any = self.any or bool(total.any())

    def __call__(self) -> Float[Tensor, "*lanes n 6"]:
        """Forces [N] and moments [N m] on all nodes, of the present design."""
        x = present_nodes(self.mesh)
        zero = x.new_zeros(len(self.mesh.nodes), 6)
        return sum((spread(self.mesh, nodes, total, x) for nodes, total in self._loads), zero)


def spread(
    mesh: Mesh | BeamLine, nodes: Sequence[int], total: Float[Tensor, " c"], x: Float[Tensor, "*lanes n 3"]
) -> Float[Tensor, "*lanes n 6"]:
    """Nodal forces and moments of a total of 3 or 6 numbers: of a uniform load on the cells between these nodes, else on the
    sides or elements between them, with moments at their ends; equal parts where a node belongs to neither. x: positions."""
    inside = torch.zeros(len(mesh.nodes), dtype=torch.bool)
    inside[list(nodes)] = True
    weight = _areas(mesh, inside)
    sides = torch.empty(0, 2, dtype=torch.long) if bool(weight.any()) else _sides(mesh, inside)
    covered = (weight > 0.0).index_fill(0, sides.flatten(), True)
    if not bool(covered[inside].all()):
        weight, sides = inside.to(weight.dtype), sides[:0]
    along = x[..., sides[:, 1], :] - x[..., sides[:, 0], :]
    length = along.norm(dim=-1)
    weight = weight.expand(*length.shape[:-1], -1).index_add(-1, sides.flatten(), 0.5 * length.repeat_interleave(2, -1))
    whole = weight.sum(-1, keepdim=True)
    bend = torch.linalg.cross((length / whole)[..., None] * total[:3], along) / 12.0
    moment = torch.zeros_like(weight)[..., None].expand(*weight.shape, 3)
    moment = moment.index_add(-2, sides[:, 1], bend).index_add(-2, sides[:, 0], -bend)
    share = (weight / whole)[..., None]
    return torch.cat([share * total[:3], moment + (share * total[3:] if len(total) == 6 else 0.0)], -1)


def _areas(mesh: Mesh | BeamLine, inside: Tensor) -> Float[Tensor, " n"]:
    """Areas of the cells whose nodes are all inside, in equal parts on their nodes."""
    weight = mesh.nodes.new_zeros(len(mesh.nodes))
    if not isinstance(mesh, BeamLine):
        for kind, corners in mesh.cells.items():
            cells = inside[corners].all(1)
            area = mesh.areas[mesh.first_cell(kind) : mesh.first_cell(kind) + len(corners)][cells] / corners.shape[1]
            weight.index_add_(0, corners[cells].flatten(), area.repeat_interleave(corners.shape[1]))
    return weight


def _sides(mesh: Mesh | BeamLine, inside: Tensor) -> Int[Tensor, "sides 2"]:
    """Sides of cells, or elements, whose nodes are both inside."""
    if isinstance(mesh, BeamLine):
        pairs = mesh.elements
    else:
        pairs = torch.cat([torch.stack([c, c.roll(-1, 1)], -1).flatten(0, 1) for c in mesh.cells.values()])
    pairs = torch.unique(pairs.sort(1).values, dim=0)
    return pairs[inside[pairs].all(1)]
