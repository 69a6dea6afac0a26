"""A mesh of cells and lines in space, checked once, with names for nodes.

Cells are counted through: all triangles, then all quadrilaterals. A directed area has the size and the normal of a cell,

    a = 1/2 sum_i (x_i - x_0) x (x_i+1 - x_0)

The winding of a cell (right-hand rule) gives its normal, and so which ply is the bottom one: neighbours must be
wound in the same sense.
Bad input is refused where it enters (mesh_checks.py), and named by element: an InputError tells which cell or node.
Checked in tests/fem/mesh/test_mesh.py.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.mesh.mesh_checks import check, directed_area
from torchmbd.math.checked_numbers import indices, reals, scalar
from torchmbd.math.gradients import constant_arguments
from torchmbd.math.plausible_units import EXTENT, warn_unusual


class CoveringTriangles(NamedTuple):
    """Triangles that cover the cells, with their nodes, weights and cells; a quadrilateral has four with the weight 1/2."""

    nodes: Int[Tensor, "pieces 3"]
    share: Float[Tensor, " pieces"]
    cell: Int[Tensor, " pieces"]


def _none(corners: int) -> Tensor:
    return torch.empty(0, corners, dtype=torch.long)


def node_members(kind: str, name: Any, members: Any) -> tuple[int, ...]:
    """Read the node indices of the set `name` of a `kind` of mesh; InputError if they are not a list of whole numbers."""
    where = f"node_sets of a {kind}: {name!r}"
    nodes = indices(where, list(members) if isinstance(members, (Sequence, set)) else members)
    if nodes.dim() != 1:
        raise InputError(str(where), members, "a list of nodes")
    return tuple(nodes.tolist())


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """Cells and lines in space, with names for nodes; the module header lists the checks.

    nodes                     positions in the axes of the body [n, 3] [m]
    triangles                 node indices, counted from 0 [m, 3]
    quads                     quadrilaterals, convex, four corners in turn, flat or slightly warped [k, 4]
    lines                     node pairs: beams, rigid links [k, 2]
    node_sets                 name -> node indices; a set of one node is a named node
    node_labels, cell_labels  names of nodes and cells in messages, such as the cards of a file
    as_given                  True: warnings instead of errors for nodes at one place, for cells with the same corners, and for
                              neighbors with opposite senses. Models of other programs may need this

    >>> corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    >>> mesh = mbd.Mesh(corners, quads=torch.tensor([[0, 1, 2, 3]]), node_sets={"tip": [2]})
    >>> mesh, mesh.node("tip"), mesh.areas.tolist()
    (Mesh(4 nodes, 0 triangles, 1 quadrilaterals, 0 lines), 2, [1.0])
    """

    nodes: Float[Tensor, "n 3"]
    triangles: Int[Tensor, "m 3"] = field(default_factory=lambda: _none(3))
    node_sets: Mapping[str, Sequence[int]] = field(default_factory=dict)
    lines: Int[Tensor, "k 2"] = field(default_factory=lambda: _none(2))
    node_labels: Sequence[str] = ()
    cell_labels: Sequence[str] = ()
    quads: Int[Tensor, "k 4"] = field(default_factory=lambda: _none(4))
    as_given: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.node_sets, Mapping):
            raise InputError("node_sets", self.node_sets, "a mapping name -> list of nodes", noun="node_sets of a Mesh")
        sets = {str(name): node_members("Mesh", name, members) for name, members in self.node_sets.items()}
        object.__setattr__(self, "nodes", reals("nodes", self.nodes))
        object.__setattr__(self, "node_sets", sets)
        for name in ("triangles", "quads", "lines"):
            elements = indices(name, getattr(self, name))
            object.__setattr__(self, name, elements)
        self._check()

    def _check(self) -> None:
        check(self)
        extent = float((self.nodes.amax(0) - self.nodes.amin(0)).norm())
        warn_unusual("nodes of a Mesh: extent", extent, "m", EXTENT)

    def __repr__(self) -> str:
        quads = f"{len(self.quads)} quadrilaterals, " if len(self.quads) else ""
        return f"Mesh({len(self.nodes)} nodes, {len(self.triangles)} triangles, {quads}{len(self.lines)} lines)"

    def node(self, name: str) -> int:
        """Return the index of a named single node."""
        members = self.node_set(name)
        if len(members) != 1:
            raise InputError(
                "node",
                name,
                allowed="must have one node",
                state=f"has {len(members)} nodes",
                noun=f"Mesh: node set {name!r}",
            )
        return members[0]

    def node_set(self, name: str) -> tuple[int, ...]:
        """Return the node indices of a named set."""
        if not isinstance(name, str):
            raise InputError("node", name, "the name of a node or node set, a str")
        if name not in self.node_sets:
            names = list(self.node_sets)
            shown = names if len(names) <= 30 else difflib.get_close_matches(str(name), names, n=8, cutoff=0.0)
            why = ""
            if f"{name}_edge" in names or name == "center":
                why = "an even number of cells along the edge, because an odd one has no node in the middle"
            raise InputError("node", name, shown, hint=why)
        return tuple(self.node_sets[name])

    @constant_arguments
    def within(self, radius: float, point: str | Sequence[float] = "center") -> tuple[int, ...]:
        """Return the nodes at most `radius` [m] from a named node or a place [m]: a patch of one size on every mesh."""
        place = self.nodes[self.node(point)] if isinstance(point, str) else self.nodes.new_tensor(point)
        if place.shape != (3,) or not radius > 0:
            raise InputError(
                "radius",
                radius,
                "must have a radius > 0, and a node or three numbers",
                state=f"({radius!r}, {point!r}) has no such place",
                noun="Mesh.within",
            )
        near = ((self.nodes - place).norm(dim=1) <= radius * (1.0 + 1e-9)).nonzero().flatten()
        if not len(near):
            raise InputError(
                "radius",
                radius,
                "must have one",
                state=f"has no node within {radius!r} m of {point!r}",
                noun="the mesh",
                hint="a larger radius",
            )
        return tuple(near.tolist())

    @constant_arguments
    def edge(self, x: float | None = None, y: float | None = None, z: float | None = None) -> tuple[int, ...]:
        """Return the nodes on the edge of the surface, the sides of one cell alone; those at given coordinates [m].

        x, y, z  coordinates of the edge, within a millionth of the extent; None: any

        >>> mesh = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(4, 2))
        >>> mesh.edge(x=-0.25) == mesh.node_set("left_edge"), len(mesh.edge())
        (True, 12)
        """
        sides = [torch.stack([c, c.roll(-1, 1)], -1).flatten(0, 1) for c in self.cells.values()]
        pairs, count = torch.unique(torch.cat(sides).sort(1).values, dim=0, return_counts=True)
        mask = torch.zeros(len(self.nodes), dtype=torch.bool)
        mask[pairs[count == 1].flatten()] = True
        near = 1e-6 * float((self.nodes.amax(0) - self.nodes.amin(0)).norm())
        for axis, at in enumerate((x, y, z)):
            if at is not None:
                mask &= (self.nodes[:, axis] - scalar(f"{'xyz'[axis]} of edge", at, "a number", " m")).abs() <= near
        if not bool(mask.any()):
            raise InputError(
                "edge",
                (x, y, z),
                "must have one",
                state=f"has no edge at x={x}, y={y}, z={z}",
                noun="the mesh",
                hint="coordinates [m] of nodes on an edge, or None",
            )
        return tuple(mask.nonzero().flatten().tolist())

    def node_name(self, k: int) -> str:
        """Name of a node in messages."""
        return self.node_labels[k] if self.node_labels else f"node {k}"

    def cell_name(self, k: int) -> str:
        """Name of a cell in messages."""
        if self.cell_labels:
            return self.cell_labels[k]
        return f"triangle {k}" if k < len(self.triangles) else f"quad {k - len(self.triangles)}"

    @property
    def cells(self) -> dict[str, Int[Tensor, "m corners"]]:
        """The corners of the cells of each kind, in the order in which cells are counted."""
        return {"triangle": self.triangles, "quad": self.quads}

    def first_cell(self, kind: str) -> int:
        """The number of the first cell of a kind."""
        return {"triangle": 0, "quad": len(self.triangles)}[kind]

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return len(self.triangles) + len(self.quads)

    @property
    def covering_triangles(self) -> CoveringTriangles:
        """Triangles that cover the cells: for every quadrilateral the mean of the two ways to cut it.

        If each triangle gives a third of its directed area to each corner, the sums at the nodes are the integrals of the
        bilinear shape functions.
        """
        corners = [self.quads.roll(1 - i, dims=1)[:, :3] for i in range(4)]
        number = torch.arange(self.cell_count)
        share = torch.ones(len(self.triangles) + 4 * len(self.quads), dtype=torch.float64)
        share[len(self.triangles) :] = 0.5
        cell = torch.cat([number[: len(self.triangles)], number[len(self.triangles) :].repeat(4)])
        return CoveringTriangles(torch.cat([self.triangles, *corners]), share, cell)

    @property
    def directed_areas(self) -> Float[Tensor, "cells 3"]:
        """Areas of the cells [m2] along their normals."""
        return torch.cat([directed_area(self.nodes[corners]) for corners in self.cells.values()])

    @property
    def normals(self) -> Float[Tensor, "cells 3"]:
        """Unit normals of the cells, by the right-hand rule of their winding."""
        a = self.directed_areas
        return a / a.norm(dim=1, keepdim=True)

    @property
    def areas(self) -> Float[Tensor, " cells"]:
        """Areas of the cells [m2], of a warped one seen along its normal."""
        return self.directed_areas.norm(dim=1)


@dataclass(frozen=True, eq=False, repr=False)
class NodeCloud(Mesh):
    """Nodes [n, 3] [m] with names of a body whose matrices come from outside; they may share a place.

    Lines are for pictures only.
    """

    def __repr__(self) -> str:
        return f"NodeCloud({len(self.nodes)} nodes)"

    def _check(self) -> None:
        nodes = self.nodes
        if nodes.ndim != 2 or nodes.shape[1] != 3 or not len(nodes) or not bool(torch.isfinite(nodes).all()):
            raise InputError("nodes", nodes, "finite numbers [n, 3]", state=f"have shape {tuple(nodes.shape)}")
        for name, members in {"lines": self.lines.flatten().tolist(), **self.node_sets}.items():
            for k in members:
                if not 0 <= k < len(nodes):
                    raise InputError(
                        ("node_sets", name),
                        k,
                        f"must have nodes from 0 to {len(nodes) - 1}",
                        noun=repr(name),
                        state=f"has node {k}",
                    )
