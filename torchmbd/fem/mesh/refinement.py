"""Meshes with twice as many cells in each direction, on the same flat cells and straight lines.

    triangle, quadrilateral -> four        line -> two

Nodes keep their numbers; those in the middles of sides, and of quadrilaterals, follow. Node sets keep their nodes.
Checked in tests/fem/mesh/test_refinement.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.fem.mesh.mesh import Mesh


@dataclass(frozen=True)
class Middles:
    """New nodes: each is the mean of old ones.

    sides    of the sides, node pairs [s, 2], first lower;  quads  of the quadrilaterals [k, 4]
    """

    sides: Int[Tensor, "s 2"]
    quads: Int[Tensor, "k 4"]
    count: int

    @classmethod
    def of(cls, cells: Sequence[Int[Tensor, "m corners"]], quads: Int[Tensor, "k 4"], count: int) -> Middles:
        """Of all sides of closed cells, or of lines, of a mesh with so many nodes."""
        sides = [torch.stack([c, c.roll(-1, 1)], -1).flatten(0, 1) for c in cells if len(c)]
        return cls(torch.unique(torch.cat(sides).sort(1).values, dim=0), quads, count)

    def nodes(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "all 3"]:
        """Old and new nodes."""
        return torch.cat([x, x[self.sides].mean(1), x[self.quads].mean(1)])

    def of_sides(self, first: Int[Tensor, " m"], second: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
        """Numbers of the nodes between pairs of nodes."""
        pairs = torch.stack([first, second], 1).sort(1).values
        key = self.sides[:, 0] * self.count + self.sides[:, 1]  # ascending, as torch.unique sorts
        return self.count + torch.searchsorted(key, pairs[:, 0] * self.count + pairs[:, 1])

    def with_middles(self, nodes: Sequence[int]) -> list[int]:
        """A set of nodes with those that lie in the middles of its sides and quadrilaterals."""
        inside = torch.zeros(self.count, dtype=torch.bool)
        inside[list(nodes)] = True
        within = torch.cat([inside[self.sides].all(1), inside[self.quads].all(1)])
        return [*nodes, *(self.count + within.nonzero()[:, 0]).tolist()]


def refined(mesh: Mesh) -> tuple[Mesh, Int[Tensor, " cells"], Middles]:
    """The finer mesh of one without lines, the cell in which each of its cells lies, and its new nodes."""
    middles = Middles.of(list(mesh.cells.values()), mesh.quads, len(mesh.nodes))
    a, b, c = mesh.triangles.T
    ab, bc, ca = (middles.of_sides(x, y) for x, y in ((a, b), (b, c), (c, a)))
    corners = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    triangles = torch.stack([torch.stack(x, 1) for x in corners], 1).flatten(0, 1)
    a, b, c, d = mesh.quads.T
    ab, bc, cd, da = (middles.of_sides(x, y) for x, y in ((a, b), (b, c), (c, d), (d, a)))
    m = len(mesh.nodes) + len(middles.sides) + torch.arange(len(mesh.quads))
    corners = ((a, ab, m, da), (ab, b, bc, m), (m, bc, c, cd), (da, m, cd, d))
    quads = torch.stack([torch.stack(x, 1) for x in corners], 1).flatten(0, 1)
    finer = Mesh(middles.nodes(mesh.nodes), triangles, mesh.node_sets, quads=quads, as_given=mesh.as_given)
    return finer, torch.arange(mesh.cell_count).repeat_interleave(4), middles
