"""Structured rectangle of quadrilaterals or triangles in the x-y plane, centred at the origin.

Quadrilaterals are the default: triangles are stiffer in torsion. Twist of the rod of torchmbd/examples/slider_crank.py at 0
degrees with 12x2, 24x4, 48x8 cells, over Saint-Venant's: 0.919, 0.965, 0.987; triangles 0.894, 0.923, 0.963.
Diagonals of triangles alternate from cell to cell, so that the mesh prefers no direction: with even numbers of cells it
is its own mirror image about both axes and the center node meets eight triangles on every refinement. (A mesh whose
diagonals all lean one way couples bending with twist by itself.)
Nodes are numbered across the direction of fewer cells first: the smallest bandwidth.
Checked in tests/fem/mesh/test_rectangle.py, tests/validation/test_rod_torsion.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchmbd.errors import InputError, unknown
from torchmbd.fem.mesh.mesh import Mesh
from torchmbd.math.checked_numbers import is_whole, positive

# Nodes of a mesh: factors of the stiffness of a million take some 560 GB (integrate/memory.py).
MOST_NODES = 1_000_000
#: Kinds of cells that it can make.
KINDS = ("quad", "triangle")


def rectangle(length: float, width: float, cells: tuple[int, int], kind: str = "quad") -> Mesh:
    """Mesh a plate of length (x) times width (y) [m] by cells = (nx, ny), normals +z.

    kind: "quad", or "triangle", two in each cell.

    Node sets: "left_edge", "right_edge" (x = -+length/2), "bottom_edge", "top_edge" (y = -+width/2), the corners
    "corner_left_bottom" and so on. If there are nodes at these points, also "left", "right", "bottom", "top" (middles of
    the edges) and "center".

    >>> plate = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(8, 2))
    >>> plate.nodes[plate.node("right")].tolist()  # [m]
    [0.25, 0.0, 0.0]
    """
    for name, value in (("length", length), ("width", width)):
        positive(name, value, "m")
    if not isinstance(cells, Sequence) or len(cells) != 2 or not all(is_whole(c) and c >= 1 for c in cells):
        raise InputError("cells", cells, "two integers >= 1", noun="rectangle: cells")
    if kind not in KINDS:
        raise unknown("kind", kind, KINDS)
    nx, ny = cells
    if (nx + 1) * (ny + 1) > MOST_NODES:
        raise InputError(
            "cells",
            cells,
            f"must have at most {MOST_NODES:,} nodes",
            noun="rectangle: cells",
            shown=repr(cells),
            state=f"have {(nx + 1) * (ny + 1):,} nodes",
        )
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx + 1), np.arange(ny + 1), indexing="ij"))
    node = (i * (ny + 1) + j if nx >= ny else j * (nx + 1) + i).reshape(nx + 1, ny + 1)
    xyz = np.zeros((node.size, 3))
    xyz[node.ravel()] = np.stack([length * (i / nx - 0.5), width * (j / ny - 0.5), 0.0 * i], axis=1)
    if kind == "quad":
        corners = np.stack([node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]], axis=-1).reshape(-1, 4)
        return Mesh(torch.from_numpy(xyz), node_sets=_named(node), quads=torch.from_numpy(corners))
    return Mesh(torch.from_numpy(xyz), torch.from_numpy(_triangles(node)), _named(node))


def _triangles(node: np.ndarray) -> np.ndarray:
    nx, ny = node.shape[0] - 1, node.shape[1] - 1
    a, b, c, d = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    rising = ((i + j + nx // 2 + ny // 2) % 2 == 0)[..., None, None]  # this parity sends diagonals through the center
    up = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2)
    down = np.stack([np.stack([a, b, d], -1), np.stack([b, c, d], -1)], -2)
    return np.where(rising, up, down).reshape(-1, 3)


def _named(node: np.ndarray) -> dict[str, list[int]]:
    nx, ny = node.shape[0] - 1, node.shape[1] - 1
    sets = {
        "left_edge": node[0, :].tolist(),
        "right_edge": node[-1, :].tolist(),
        "bottom_edge": node[:, 0].tolist(),
        "top_edge": node[:, -1].tolist(),
        "corner_left_bottom": [int(node[0, 0])],
        "corner_right_bottom": [int(node[-1, 0])],
        "corner_right_top": [int(node[-1, -1])],
        "corner_left_top": [int(node[0, -1])],
    }
    if ny % 2 == 0:
        sets |= {"left": [int(node[0, ny // 2])], "right": [int(node[-1, ny // 2])]}
    if nx % 2 == 0:
        sets |= {"bottom": [int(node[nx // 2, 0])], "top": [int(node[nx // 2, -1])]}
    if nx % 2 == 0 and ny % 2 == 0:
        sets["center"] = [int(node[nx // 2, ny // 2])]
    return sets
