"""Checks of a mesh; the InputError of each names cell and node.

Nodes that are not finite or share one place; cells with unknown, repeated or collinear corners, concave or strongly warped;
duplicates; nodes of no element; neighbours wound in opposite senses; disconnected parts; node sets outside of the mesh.
A mesh "as given" may have nodes at one place, duplicates and opposite senses: the latter two are warned of.
Checked in tests/fem/mesh/test_mesh.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from torchmbd.errors import InputError, warn

#: A cell is collapsed when a corner's height over the longest side is less than this part of that side.
FLATNESS = 1e-6

#: Nodes nearer to each other than this part of the mesh's size share one place: a seam that was not merged.
SEPARATION = 1e-7

#: A quadrilateral whose corners lean by more than this to its normal is no plate any more [rad].
WARP = math.radians(40.0)


class Cells(Protocol):
    """A mesh as the checks use it; see `Mesh`."""

    @property
    def nodes(self) -> Tensor: ...
    @property
    def triangles(self) -> Tensor: ...
    @property
    def quads(self) -> Tensor: ...
    @property
    def lines(self) -> Tensor: ...
    @property
    def node_sets(self) -> Mapping[str, Sequence[int]]: ...
    @property
    def cells(self) -> dict[str, Tensor]: ...
    @property
    def cell_count(self) -> int: ...
    @property
    def as_given(self) -> bool: ...
    def first_cell(self, kind: str) -> int: ...
    def cell_name(self, k: int) -> str: ...
    def node_name(self, k: int) -> str: ...


def directed_area(p: Float[Tensor, "m corners 3"]) -> Float[Tensor, "m 3"]:
    """Area of polygons along their normals [m2]; of a triangle half the cross product of two sides, to the last digit."""
    arms = p - p[:, :1]
    return torch.linalg.cross(arms[:, 1:-1], arms[:, 2:]).sum(1) / 2.0


def repeated_rows(rows: np.ndarray) -> Int[np.ndarray, "k 2"]:
    """Rows that repeat an earlier one: that one's index, and theirs."""
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    earlier = first[inverse.ravel()]
    again = np.flatnonzero(earlier != np.arange(len(rows)))
    return np.stack([earlier[again], again], axis=1)


def connected_parts(tail: np.ndarray, head: np.ndarray, nodes: int) -> tuple[int, int]:
    """Number of parts of a graph of node pairs, and a node that is not connected with node 0 (0: there is none)."""
    graph = coo_array((np.ones(len(tail)), (tail, head)), shape=(nodes, nodes))
    parts, label = connected_components(graph, directed=False)
    return parts, int(np.argmax(label != label[0]))


def check(mesh: Cells) -> None:
    """Raise InputError for the first fault of a mesh."""
    _check_nodes(mesh)
    _check_shapes(mesh)
    for kind, corners in mesh.cells.items():
        _check_cells(mesh, corners, mesh.first_cell(kind))
    _check_orphans(mesh)
    _check_lines(mesh)
    _check_winding(mesh)
    _check_connected(mesh)
    for name, members in mesh.node_sets.items():
        for k in members:
            if not 0 <= k < len(mesh.nodes):
                raise InputError(
                    ("node_sets", name),
                    k,
                    f"must have nodes from 0 to {len(mesh.nodes) - 1}",
                    state=f"has node {k}",
                    noun=f"Mesh: node_sets[{name!r}]",
                )


def _check_nodes(mesh: Cells) -> None:
    nodes = mesh.nodes
    if nodes.ndim != 2 or nodes.shape[1] != 3 or len(nodes) < 2:
        raise InputError(
            "nodes",
            nodes,
            "must have shape [n, 3] with n >= 2",
            noun="Mesh: nodes",
            state=f"has shape {tuple(nodes.shape)}",
        )
    bad = (~torch.isfinite(nodes)).any(dim=1).nonzero().flatten()
    if len(bad):
        k = int(bad[0])
        raise InputError(
            ("nodes", k),
            nodes[k].tolist(),
            "finite coordinates",
            state=f"is at {nodes[k].tolist()}",
            noun=f"Mesh: {mesh.node_name(k)}",
        )
    if mesh.as_given:
        return
    size = float((nodes.amax(0) - nodes.amin(0)).norm())
    twins = KDTree(nodes.numpy()).query_pairs(SEPARATION * size, output_type="ndarray")
    plates = {k for corners in mesh.cells.values() for k in corners.flatten().tolist()}
    joined = {frozenset(line) for line in mesh.lines.tolist()} if len(twins) else set()
    for other, k in sorted(twins.tolist()):
        # The node of a rigid link may lie on a node of the plate, and a spring may join two nodes of plates.
        if ({k, other} <= plates and frozenset((k, other)) not in joined) or not len(mesh.lines):
            raise InputError(
                ("nodes", k),
                allowed="apart",
                hint="one node in place of both",
                noun=f"Mesh: {mesh.node_name(other)} and {mesh.node_name(k)}",
                state=f"share one place {nodes[k].tolist()}",
            )


def _refuse(mesh: Cells, k: int, noun: str, state: str, allowed: str, count: int) -> None:
    """Raise the InputError of cell k; for a mesh `as_given` warn instead."""
    error = InputError(("cells", k), allowed=allowed, noun=f"Mesh: {noun}", state=state)
    if not mesh.as_given:
        raise error
    warn(f"{error} ({count} in all); taken as they are")


def _check_shapes(mesh: Cells) -> None:
    for name, corners, width in (("triangles", mesh.triangles, 3), ("quads", mesh.quads, 4)):
        if corners.ndim != 2 or corners.shape[1] != width:
            raise InputError(
                (name,),
                allowed=f"must have shape [m, {width}]",
                state=f"has shape {tuple(corners.shape)}",
                noun=f"Mesh: {name}",
            )
    if mesh.cell_count + len(mesh.lines) == 0:
        raise InputError(
            "triangles",
            allowed="must have at least one",
            state="has no triangles, no quads and no lines",
            noun="Mesh: it",
        )


def _check_cells(mesh: Cells, corners: Tensor, start: int) -> None:
    """Check the cells of one kind; `start` is the number of the first."""
    n = len(mesh.nodes)
    bad = ((corners < 0) | (corners >= n)).any(dim=1).nonzero().flatten()
    if len(bad):
        k = int(bad[0])
        raise InputError(
            ("cells", start + k),
            corners[k].tolist(),
            f"must have nodes from 0 to {n - 1}",
            state=f"has nodes {corners[k].tolist()}",
            noun=f"Mesh: {mesh.cell_name(start + k)}",
        )
    duplicates = repeated_rows(np.sort(corners.numpy(), axis=1))
    if len(duplicates):
        original, copy = (mesh.cell_name(start + int(k)) for k in duplicates[0])
        nodes = corners[duplicates[0, 1]].tolist()
        _refuse(
            mesh,
            start + int(duplicates[0, 1]),
            f"{original} and {copy}",
            f"are duplicates, nodes {nodes}",
            "different",
            len(duplicates),
        )
    p = mesh.nodes[corners]
    ahead, back, area = p.roll(-1, dims=1) - p, p.roll(1, dims=1) - p, directed_area(p)
    height = torch.linalg.cross(ahead, back)  # of every corner: twice its triangle's directed area
    along = (height * (area / area.norm(dim=1, keepdim=True))[:, None]).sum(2)
    open = (along > FLATNESS * ahead.norm(dim=2).amax(dim=1, keepdim=True) ** 2).all(1)
    flat = (along > math.cos(WARP) * height.norm(dim=2)).all(1)
    wrong = (~open).nonzero().flatten().tolist()
    if wrong:
        name, nodes = mesh.cell_name(start + wrong[0]), corners[wrong[0]].tolist()
        state, allowed = "is collapsed, concave or crosses itself", "convex, with corners in turn"
        if corners.shape[1] == 3:
            state, allowed = "is collapsed", "must have corners that are not on a line"
        raise InputError(("cells", start + wrong[0]), nodes, allowed, noun=f"Mesh: {name}, nodes {nodes},", state=state)
    wrong = (~flat).nonzero().flatten().tolist()
    if wrong:
        name, nodes = mesh.cell_name(start + wrong[0]), corners[wrong[0]].tolist()
        state, allowed = "is warped by more than 40 degrees", "flatter, or cut in two"
        _refuse(mesh, start + wrong[0], f"{name}, nodes {nodes},", state, allowed, len(wrong))


def _check_orphans(mesh: Cells) -> None:
    n = len(mesh.nodes)
    used = torch.zeros(n, dtype=torch.bool)
    for corners in (*mesh.cells.values(), mesh.lines.clamp(0, n - 1)):
        used[corners.flatten()] = True
    if not used.all():
        orphans = (~used).nonzero().flatten().tolist()
        names = ", ".join(mesh.node_name(k) for k in orphans[:8])
        raise InputError(
            "nodes",
            allowed="nodes of elements",
            hint="a mesh without them",
            noun=f"Mesh: {len(orphans)} orphan nodes",
            state=f"belong to no element: {names}",
        )


def _check_lines(mesh: Cells) -> None:
    lines, n = mesh.lines, len(mesh.nodes)
    if lines.ndim != 2 or lines.shape[1] != 2:
        raise InputError(
            "lines", lines, "must have shape [k, 2]", noun="Mesh: lines", state=f"has shape {tuple(lines.shape)}"
        )
    bad = ((lines < 0) | (lines >= n)).any(dim=1) | (lines[:, 0] == lines[:, 1])
    if bad.any():
        k = int(bad.nonzero()[0])
        raise InputError(
            ("lines", k),
            lines[k].tolist(),
            f"must have two different nodes from 0 to {n - 1}",
            state=f"has nodes {lines[k].tolist()}",
            noun=f"Mesh: line {k}",
        )


def _sides(mesh: Cells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First and second node of every side, and its cell."""
    kinds = [corners.numpy() for corners in mesh.cells.values()]
    tail = np.concatenate([c.ravel() for c in kinds])
    head = np.concatenate([np.roll(c, -1, axis=1).ravel() for c in kinds])
    owner = np.repeat(np.arange(mesh.cell_count), np.concatenate([np.full(len(c), c.shape[1]) for c in kinds]))
    return tail, head, owner


def _check_winding(mesh: Cells) -> None:
    """Refuse an edge that two cells run through in the same direction: one of them is inverted."""
    tail, head, owner = _sides(mesh)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    _, inverse, count = np.unique(np.stack([low, high]), axis=1, return_inverse=True, return_counts=True)
    sense = np.bincount(inverse.ravel(), weights=np.where(tail < head, 1.0, -1.0))
    wrong = np.flatnonzero((count == 2) & (sense != 0.0))  # at a branch of three or more plates no sense is right
    if len(wrong):
        nodes = [row for corners in mesh.cells.values() for row in corners.tolist()]
        a, b = owner[inverse.ravel() == wrong[0]].tolist()
        _refuse(
            mesh,
            b,
            f"{mesh.cell_name(a)}, nodes {nodes[a]}, and {mesh.cell_name(b)}, nodes {nodes[b]},",
            "are wound in opposite senses",
            "wound in one sense",
            len(wrong),
        )


def _check_connected(mesh: Cells) -> None:
    (tail, head, _), lines, n = _sides(mesh), mesh.lines.numpy(), len(mesh.nodes)
    tail, head = np.concatenate([tail, lines[:, 0]]), np.concatenate([head, lines[:, 1]])
    parts, stray = connected_parts(tail, head, n)
    if parts > 1:
        raise InputError(
            "elements",
            allowed="one connected part",
            state=f"is not connected with {mesh.node_name(0)})",
            noun=f"Mesh: {parts} disconnected parts ({mesh.node_name(stray)}",
        )
