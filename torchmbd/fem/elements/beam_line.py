"""The mesh of a beam: nodes on a line in space, two-node elements between them, names for nodes.

nodes      positions in the axes of the body   [n, 3], m
elements   node indices (start, end)           [m, 2]
node_sets  name -> node indices; a set of one node is a named node
middles    of elements that are arcs of circles, on their arcs halfway   [m, 3], m; None: all are straight

An element's x-axis runs from its start to its end, along the tangent of an arc. Branches and closed loops are allowed;
parts must hang together. Nodes may be functions of parameters, geometry as a design:

    BeamLine(torch.nn.Parameter(nodes))               the nodes themselves: "rod.line.nodes"
    BeamLine.straight(length=mbd.variable(0.3))       a length: "rod.line.length"
    BeamLine(module)                                  any torch module without arguments that returns nodes [n, 3] [m]

A module is evaluated for each design by itself, so it has no axis of lanes. Straight elements only.
Checked in tests/fem/elements/test_beam_line.py, tests/sensitivity/test_node_variables.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor, nn

from torchmbd.errors import InputError, unknown
from torchmbd.fem.mesh.mesh import node_members
from torchmbd.fem.mesh.mesh_checks import connected_parts, repeated_rows
from torchmbd.math.checked_numbers import indices, is_whole, parameter, reals
from torchmbd.math.gradients import constant_arguments
from torchmbd.math.plausible_units import EXTENT, warn_unusual
from torchmbd.math.variable import ParameterVector, is_variable, number


class Nodes(nn.Module):
    """Nodes that are a parameter [n, 3]."""

    nodes: Tensor

    def __init__(self, nodes: nn.Parameter):
        super().__init__()
        self.nodes = parameter("nodes", nodes)

    def forward(self) -> Tensor:
        return self.nodes


class Straight(nn.Module):
    """Nodes at shares of a length [m]."""

    positive = ("length",)
    length: Tensor
    _unit: Tensor

    def __init__(self, length: Any, unit: Float[Tensor, "n 3"]):
        super().__init__()
        self.length = length
        self.register_buffer("_unit", unit, persistent=False)

    def forward(self) -> Tensor:
        return self.length * self._unit


def evaluate_nodes(shape: nn.Module) -> Tensor:
    """Return the present nodes of a module [n, 3] without gradient; InputError if it returns something else."""
    with torch.no_grad():
        nodes = shape()
    if not isinstance(nodes, Tensor) or nodes.dtype != torch.float64 or nodes.ndim != 2 or nodes.shape[1] != 3:
        allowed = "nodes [n, 3] in float64"
        raise InputError("nodes", allowed=allowed, state=f"returns {nodes!r}", noun="the module of a BeamLine")
    return nodes.detach().clone()


def varying_nodes(mesh: Any) -> bool:
    """True if the nodes of a mesh depend on the design."""
    return getattr(mesh, "node_module", None) is not None


def present_nodes(mesh: Any) -> Float[Tensor, "*lanes n 3"]:
    """Nodes of a mesh in the present design [m]."""
    if not varying_nodes(mesh):
        return mesh.nodes
    variables: ParameterVector = mesh.variables
    return variables.evaluated()


class BeamLine:
    """A chain or net of beam elements.

    nodes      positions [n, 3] [m]; a torch.nn.Parameter, or a module that returns them, is a design variable
    elements   node pairs [m, 2]; default: each node with the next
    node_sets  name -> node indices; default: "start" and "end" of a chain
    middles    points halfway along elements that are arcs [m, 3] [m]

    >>> line = mbd.BeamLine.straight(1.2, elements=4)
    >>> line.nodes[line.node("end")].tolist()  # [m]
    [1.2, 0.0, 0.0]
    >>> arc = mbd.BeamLine.arc(radius=0.5, angle=np.pi / 2, elements=4)
    >>> arc.nodes[arc.node("end")].round(decimals=6).tolist()
    [0.5, 0.5, 0.0]
    """

    nodes: Float[Tensor, "n 3"]
    elements: Int[Tensor, "m 2"]
    node_sets: Mapping[str, Sequence[int]]
    middles: Float[Tensor, "m 3"] | None
    node_module: nn.Module | None

    def __init__(
        self,
        nodes: ArrayLike | Tensor | nn.Module,
        elements: ArrayLike | Tensor | None = None,
        node_sets: Mapping[str, Sequence[int]] | None = None,
        middles: ArrayLike | Tensor | None = None,
    ) -> None:
        self.node_module = (
            Nodes(nodes) if isinstance(nodes, nn.Parameter) else nodes if isinstance(nodes, nn.Module) else None
        )
        self.variables = ParameterVector.of(self.node_module)
        numbers: Any = nodes if self.node_module is None else evaluate_nodes(self.node_module)
        self.nodes = reals("nodes", numbers)
        if self.node_module is not None and middles is not None:
            raise InputError(
                "nodes",
                nodes,
                "constant, or be those of a line without middles (straight elements)",
                noun="nodes of a BeamLine",
                state="are design variables, but the line has middles (arcs)",
            )
        _check_nodes(self.nodes)
        chain = np.array(list(pairwise(range(len(self.nodes)))))
        self.elements = indices("elements", chain if elements is None else elements)
        _check_elements(self.nodes, self.elements)
        self.middles = None if middles is None else reals("middles", middles)
        if self.middles is not None:
            _check_middles(self.nodes[self.elements], self.middles)
        if node_sets is None:
            node_sets = {"start": [0], "end": [len(self.nodes) - 1]} if elements is None else {}
        if not isinstance(node_sets, Mapping):
            raise InputError("node_sets", node_sets, "a mapping name -> list of nodes", noun="node_sets of a BeamLine")
        self.node_sets = {str(name): node_members("BeamLine", name, members) for name, members in node_sets.items()}
        for name, members in self.node_sets.items():
            for k in members:
                if not 0 <= k < len(self.nodes):
                    raise InputError(
                        ("node_sets", name),
                        k,
                        f"must have nodes from 0 to {len(self.nodes) - 1}",
                        state=f"has node {k}",
                        noun=f"BeamLine: node_sets[{name!r}]",
                    )

    @classmethod
    @constant_arguments
    def straight(
        cls, length: float | Tensor, elements: int = 16, direction: Sequence[float] = (1.0, 0.0, 0.0)
    ) -> BeamLine:
        """Return a straight line from the origin along `direction` with equal elements. Its named nodes are "start", "end",
        and "center" if there is a node in the middle.

        length   [m]; mbd.variable(...) is a design variable of the body, "rod.line.length"
        """
        if not 0.0 < number(length) < float("inf"):
            raise InputError("length", length, "a finite number > 0", noun="BeamLine: length", shown=f"{length!r} m")
        if not is_whole(elements) or elements < 1:
            raise InputError("elements", elements, "an integer >= 1", noun="BeamLine: elements")
        d = np.asarray(direction, dtype=float)
        if d.shape != (3,) or not np.isfinite(d).all() or not d.any():
            raise InputError(
                "direction",
                direction,
                "three finite numbers, not all zero",
                noun="BeamLine: direction",
            )
        unit = np.linspace(0.0, 1.0, elements + 1)[:, None] * d / np.linalg.norm(d)
        nodes: Any = Straight(length, torch.from_numpy(unit)) if is_variable(length) else unit * float(length)
        sets = {"start": [0], "end": [elements]} | ({"center": [elements // 2]} if elements % 2 == 0 else {})
        return cls(nodes, node_sets=sets)

    @classmethod
    @constant_arguments
    def arc(cls, radius: float, angle: float, elements: int = 16) -> BeamLine:
        """Arc of a circle in the x-y plane, from the origin along +x, bending to +y. Nodes "start", "end", "center".

        radius   [m]
        angle    from the first tangent to the last [rad], less than a whole turn; an element takes half a turn at most
        """
        if not 0.0 < radius < float("inf"):
            raise InputError("radius", radius, "a finite number > 0", noun="BeamLine: radius", shown=f"{radius!r} m")
        if not 0.0 < angle < 2.0 * np.pi:
            raise InputError("angle", angle, "0 to 2 pi", noun="BeamLine: angle", shown=f"{angle!r} rad")
        if not is_whole(elements) or elements < 1 or angle > np.pi * elements:
            raise InputError(
                "elements",
                elements,
                "an integer >= 1, one for each half turn",
                noun="BeamLine: elements",
            )
        at = np.linspace(0.0, angle, 2 * elements + 1)
        places = radius * np.stack([np.sin(at), 1.0 - np.cos(at), 0.0 * at], axis=1)
        sets = {"start": [0], "end": [elements]} | ({"center": [elements // 2]} if elements % 2 == 0 else {})
        return cls(places[::2], node_sets=sets, middles=places[1::2])

    def node(self, name: str) -> int:
        """Return the index of a named single node."""
        members = self.node_set(name)
        if len(members) != 1:
            raise InputError(
                "node",
                name,
                "must have one node",
                noun=f"BeamLine: node set {name!r}",
                state=f"has {len(members)} nodes",
            )
        return members[0]

    def node_set(self, name: str) -> tuple[int, ...]:
        """Return the node indices of a named set."""
        if name not in self.node_sets:
            raise unknown("node", name, self.node_sets)
        return tuple(self.node_sets[name])


def _check_nodes(nodes: Tensor) -> None:
    if nodes.ndim != 2 or nodes.shape[1] != 3 or len(nodes) < 2:
        raise InputError(
            "nodes",
            nodes,
            "must have shape [n, 3] with n >= 2",
            noun="BeamLine: nodes",
            state=f"has shape {tuple(nodes.shape)}",
        )
    bad = (~torch.isfinite(nodes)).any(dim=1).nonzero().flatten()
    if len(bad):
        raise InputError(
            ("nodes", int(bad[0])),
            nodes[bad[0]].tolist(),
            "finite coordinates",
            state=f"is at {nodes[bad[0]].tolist()}",
            noun=f"BeamLine: node {int(bad[0])}",
        )
    warn_unusual("extent of a BeamLine", float((nodes.amax(0) - nodes.amin(0)).norm()), "m", EXTENT)
    for first, k in repeated_rows(nodes.numpy()):
        raise InputError(
            ("nodes", k),
            allowed="apart",
            hint="one node in place of both",
            noun=f"BeamLine: nodes {first} and {k}",
            state=f"share one place {nodes[k].tolist()}",
        )


def _check_elements(nodes: Tensor, elements: Tensor) -> None:
    n = len(nodes)
    if elements.ndim != 2 or elements.shape[1] != 2 or len(elements) == 0:
        raise InputError(
            "elements",
            elements,
            "must have shape [m, 2] with m >= 1",
            noun="BeamLine: elements",
            state=f"has shape {tuple(elements.shape)}",
        )
    bad = ((elements < 0) | (elements >= n)).any(dim=1).nonzero().flatten()
    if len(bad):
        raise InputError(
            ("elements", int(bad[0])),
            allowed=f"must have nodes from 0 to {n - 1}",
            state=f"has nodes {elements[bad[0]].tolist()}",
            noun=f"BeamLine: element {int(bad[0])}",
        )
    for first, k in repeated_rows(np.sort(elements.numpy(), axis=1)):
        raise InputError(
            ("elements", k),
            noun=f"BeamLine: elements {first} and {k}",
            allowed="different",
            state=f"are duplicates, nodes {elements[k].tolist()}",
        )
    length = (nodes[elements[:, 1]] - nodes[elements[:, 0]]).norm(dim=1)
    short = (length <= 1e-9 * length.max()).nonzero().flatten()
    if len(short):
        k = int(short[0])
        raise InputError(
            ("elements", k),
            allowed="must have two nodes at two places",
            hint="one node in place of both",
            noun=f"BeamLine: element {k}, nodes {elements[k].tolist()},",
            state="has no length",
        )
    tail, head = elements.numpy().T
    parts, stray = connected_parts(tail, head, n)
    if parts > 1:
        raise InputError(
            "elements",
            allowed="one connected part",
            state="is not connected with node 0)",
            noun=f"BeamLine: {parts} disconnected parts (node {stray}",
        )


def _check_middles(ends: Tensor, middles: Tensor) -> None:
    if middles.shape != (len(ends), 3) or not torch.isfinite(middles).all():
        raise InputError(
            "middles",
            middles,
            f"must have shape [{len(ends)}, 3], finite",
            noun="BeamLine: middles",
            state=f"has shape {tuple(middles.shape)}",
        )
    start, end = ends.unbind(1)
    chord, arrow = end - start, middles - 0.5 * (start + end)
    c, b = chord.norm(dim=1), arrow.norm(dim=1)
    wrong = (((chord * arrow).sum(1).abs() > 1e-6 * c**2) | (b > 0.5 * (1 + 1e-9) * c)).nonzero().flatten()
    if len(wrong):
        k = int(wrong[0])
        raise InputError(
            ("middles", k),
            middles[k].tolist(),
            "as far from its start as from its end, on an arc of at most half a turn",
            state=f"is at {middles[k].tolist()}",
            noun=f"BeamLine: middle of element {k}",
        )
