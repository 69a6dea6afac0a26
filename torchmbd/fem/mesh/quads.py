"""Quadrilaterals cut into triangles, with no direction preferred: for pictures, and for users who want triangles.

A quadrilateral is cut along its shorter diagonal. Where both are nearly equal, as in a mesh of squares, the choice would
lean all cuts one way and couple bending with twist; so the nodes are colored like a chessboard along the sides, and the
cut joins nodes of one color: the diagonals then alternate from cell to cell, whatever the numbering.
Checked in tests/fem/mesh/test_quads.py.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from torch import Tensor

#: Diagonals that differ by less than this part are taken as equal.
EQUAL = 0.05


def cut_quads(nodes: Float[Tensor, "n 3"], quads: Int[Tensor, "m 4"]) -> Int[Tensor, "m 2 3"]:
    """Return two triangles for each quadrilateral, wound as it is."""
    if len(quads) == 0:
        return torch.empty(0, 2, 3, dtype=torch.long)
    p = nodes[quads]
    d02, d13 = (p[:, 2] - p[:, 0]).norm(dim=1), (p[:, 3] - p[:, 1]).norm(dim=1)
    odd = torch.from_numpy(_colors(len(nodes), quads.numpy()))[quads]
    alternating = odd[:, 0] == odd[:, 2]  # a chessboard exists here
    chosen = torch.where((d02 - d13).abs() < EQUAL * d02, ~(odd[:, 0] & alternating), d02 <= d13)
    first = torch.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], dim=1)
    second = torch.stack([quads[:, [0, 1, 3]], quads[:, [1, 2, 3]]], dim=1)
    return torch.where(chosen[:, None, None], first, second)


def _colors(n: int, quads: np.ndarray) -> np.ndarray:
    """True if each node is an odd number of sides away from the first node of its part."""
    tail, head = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    graph = coo_array((np.ones(len(tail)), (tail, head)), shape=(n, n)).tocsr()
    count, label = connected_components(graph, directed=False)
    odd = np.zeros(n, dtype=bool)
    starts = np.unique(label, return_index=True)[1]
    busy = np.unique(label[quads[:, 0]])
    for part in busy if count else []:
        order, before = breadth_first_order(graph, starts[part], directed=False)
        for node in order[1:].tolist():
            odd[node] = not odd[before[node]]
    return odd
