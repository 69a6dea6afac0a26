"""A mesh of flat triangles and lines in space, checked once, with names for nodes.

nodes       positions in the axes of the body   [n, 3], m
triangles   node indices, counted from 0        [m, 3]
lines       node pairs: beams, rigid links      [k, 2]
node_sets   name -> node indices; a set of one node is a named node
labels      what messages call the nodes and triangles: a reader names the cards of its file

The winding of a triangle (right-hand rule) gives its normal, and so which ply is the bottom one: neighbours must be
wound in the same sense.
Bad input is refused here, at the door, and named by element: an InputError tells which triangle or node.
Checked in tests/mesh/test_mesh.py.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from torchmbd.errors import InputError, unknown

#: A triangle is collapsed when its height over its longest side is less than this part of that side.
FLATNESS = 1e-6

#: Nodes nearer to each other than this part of the mesh's size share one place: a seam that was not merged.
SEPARATION = 1e-7


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """Nodes [n, 3] in m, triangles [m, 3] and named node sets; see the module header for what is checked."""

    nodes: Float[Tensor, "n 3"]
    triangles: Int[Tensor, "m 3"]
    node_sets: Mapping[str, Sequence[int]] = field(default_factory=dict)
    lines: Int[Tensor, "k 2"] = field(default_factory=lambda: torch.empty(0, 2, dtype=torch.long))
    node_labels: Sequence[str] = ()
    triangle_labels: Sequence[str] = ()

    def __post_init__(self) -> None:
        nodes = torch.as_tensor(self.nodes, dtype=torch.float64).detach().clone()
        triangles = torch.as_tensor(self.triangles, dtype=torch.long).detach().clone()
        sets = {str(name): tuple(int(k) for k in members) for name, members in self.node_sets.items()}
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "triangles", triangles)
        object.__setattr__(self, "node_sets", sets)
        object.__setattr__(self, "lines", torch.as_tensor(self.lines, dtype=torch.long).detach().clone())
        _check_nodes(self)
        _check_triangles(self)
        _check_lines(self)
        _check_winding(self)
        _check_connected(self)
        for name, members in sets.items():
            for k in members:
                if not 0 <= k < len(nodes):
                    raise InputError(f"Mesh: node_sets[{name!r}] has node {k}; allowed: 0 to {len(nodes) - 1}")

    def __repr__(self) -> str:
        return f"Mesh({len(self.nodes)} nodes, {len(self.triangles)} triangles, {len(self.lines)} lines)"

    def node(self, name: str) -> int:
        """Return the index of a named single node."""
        members = self.node_set(name)
        if len(members) != 1:
            raise InputError(f"Mesh: node set {name!r} has {len(members)} nodes; a single named node is needed")
        return members[0]

    def node_set(self, name: str) -> tuple[int, ...]:
        """Return the node indices of a named set."""
        if name not in self.node_sets:
            names = list(self.node_sets)
            shown = names if len(names) <= 30 else difflib.get_close_matches(str(name), names, n=8, cutoff=0.0)
            raise unknown("node", name, shown)
        return tuple(self.node_sets[name])

    def within(self, radius: float, point: str | Sequence[float] = "center") -> tuple[int, ...]:
        """Return the nodes at most `radius` [m] from a named node or a place [m]: a patch of one size on every mesh."""
        place = self.nodes[self.node(point)] if isinstance(point, str) else self.nodes.new_tensor(point)
        if place.shape != (3,) or not radius > 0:
            raise InputError(f"Mesh: within({radius!r}, {point!r}); allowed: a radius > 0, and a node or three numbers")
        near = ((self.nodes - place).norm(dim=1) <= radius * (1.0 + 1e-9)).nonzero().flatten()
        if not len(near):
            raise InputError(f"Mesh: no node within {radius!r} m of {point!r}; allowed: a larger radius")
        return tuple(near.tolist())

    def node_name(self, k: int) -> str:
        """What messages call a node."""
        return self.node_labels[k] if self.node_labels else f"node {k}"

    def triangle_name(self, k: int) -> str:
        """What messages call a triangle."""
        return self.triangle_labels[k] if self.triangle_labels else f"triangle {k}"

    @property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Unit normals of the triangles, by the right-hand rule of their winding."""
        p = self.nodes[self.triangles]
        n = torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        return n / n.norm(dim=1, keepdim=True)

    @property
    def areas(self) -> Float[Tensor, " m"]:
        """Areas of the triangles [m2]."""
        return _double_areas(self.nodes[self.triangles]) / 2.0


def _double_areas(p: Tensor) -> Tensor:
    return torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]).norm(dim=1)


def _check_nodes(mesh: Mesh) -> None:
    nodes = mesh.nodes
    if nodes.ndim != 2 or nodes.shape[1] != 3 or len(nodes) < 2:
        raise InputError(f"Mesh: nodes has shape {tuple(nodes.shape)}; allowed: [n, 3] with n >= 2")
    bad = (~torch.isfinite(nodes)).any(dim=1).nonzero().flatten()
    if len(bad):
        k = int(bad[0])
        raise InputError(f"Mesh: {mesh.node_name(k)} is at {nodes[k].tolist()}; allowed: finite coordinates")
    size = float((nodes.amax(0) - nodes.amin(0)).norm())
    twins = KDTree(nodes.numpy()).query_pairs(SEPARATION * size, output_type="ndarray")
    plates = set(mesh.triangles.flatten().tolist())
    for other, k in sorted(twins.tolist()):
        if {k, other} <= plates or not len(mesh.lines):  # the node of a rigid link may lie on a node of the plate
            raise InputError(
                f"Mesh: {mesh.node_name(other)} and {mesh.node_name(k)} share one place {nodes[k].tolist()}; merge them"
            )


def _check_triangles(mesh: Mesh) -> None:
    nodes, triangles, n = mesh.nodes, mesh.triangles, len(mesh.nodes)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) + len(mesh.lines) == 0:
        raise InputError(f"Mesh: triangles has shape {tuple(triangles.shape)}; allowed: [m, 3] with m >= 1")
    bad = ((triangles < 0) | (triangles >= n)).any(dim=1).nonzero().flatten()
    if len(bad):
        k = int(bad[0])
        raise InputError(f"Mesh: {mesh.triangle_name(k)} has nodes {triangles[k].tolist()}; allowed: 0 to {n - 1}")
    ordered = np.sort(triangles.numpy(), axis=1)
    _, first, inverse = np.unique(ordered, axis=0, return_index=True, return_inverse=True)
    twin = np.flatnonzero(first[inverse.ravel()] != np.arange(len(ordered)))
    if len(twin):
        k = int(twin[0])
        one, two = mesh.triangle_name(int(first[inverse.ravel()[k]])), mesh.triangle_name(k)
        raise InputError(f"Mesh: {one} and {two} are duplicates, nodes {triangles[k].tolist()}")
    p = nodes[triangles]
    longest = (p - p.roll(-1, dims=1)).norm(dim=2).amax(dim=1)
    flat = (_double_areas(p) <= FLATNESS * longest**2).nonzero().flatten()
    if len(flat):
        k = int(flat[0])
        raise InputError(
            f"Mesh: {mesh.triangle_name(k)}, nodes {triangles[k].tolist()}, is collapsed (its corners are on a line)"
        )
    used = torch.zeros(n, dtype=torch.bool)
    used[triangles.flatten()] = True
    used[mesh.lines.flatten().clamp(0, n - 1)] = True
    if not used.all():
        orphans = (~used).nonzero().flatten().tolist()
        names = ", ".join(mesh.node_name(k) for k in orphans[:8])
        raise InputError(f"Mesh: {len(orphans)} orphan nodes belong to no element: {names}; remove them")


def _check_lines(mesh: Mesh) -> None:
    lines, n = mesh.lines, len(mesh.nodes)
    if lines.ndim != 2 or lines.shape[1] != 2:
        raise InputError(f"Mesh: lines has shape {tuple(lines.shape)}; allowed: [k, 2]")
    bad = ((lines < 0) | (lines >= n)).any(dim=1) | (lines[:, 0] == lines[:, 1])
    if bad.any():
        k = int(bad.nonzero()[0])
        raise InputError(f"Mesh: line {k} has nodes {lines[k].tolist()}; allowed: two different ones of 0 to {n - 1}")


def _check_winding(mesh: Mesh) -> None:
    """Refuse an edge that two triangles run through in the same direction: one of them is inverted."""
    triangles = mesh.triangles.numpy()
    tail, head = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    owner = np.repeat(np.arange(len(triangles)), 3)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    _, inverse, count = np.unique(np.stack([low, high]), axis=1, return_inverse=True, return_counts=True)
    sense = np.bincount(inverse.ravel(), weights=np.where(tail < head, 1.0, -1.0))
    wrong = np.flatnonzero((count == 2) & (sense != 0.0))  # at a branch of three or more plates no sense is right
    if len(wrong):
        a, b = owner[inverse.ravel() == wrong[0]].tolist()
        raise InputError(
            f"Mesh: {mesh.triangle_name(a)}, nodes {triangles[a].tolist()}, and {mesh.triangle_name(b)}, nodes "
            f"{triangles[b].tolist()}, are wound in opposite senses: one of them is inverted"
        )


def _check_connected(mesh: Mesh) -> None:
    triangles, lines, n = mesh.triangles.numpy(), mesh.lines.numpy(), len(mesh.nodes)
    tail = np.concatenate([triangles.ravel(), lines[:, 0]])
    head = np.concatenate([np.roll(triangles, -1, axis=1).ravel(), lines[:, 1]])
    parts, label = connected_components(coo_array((np.ones(len(tail)), (tail, head)), shape=(n, n)), directed=False)
    if parts > 1:
        stray = int(np.flatnonzero(label != label[0])[0])
        raise InputError(
            f"Mesh: {parts} disconnected parts ({mesh.node_name(stray)} is not connected with {mesh.node_name(0)}); "
            "allowed: one"
        )
