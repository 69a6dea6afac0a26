"""The mesh of a cross-section: triangles and quadrilaterals in the y-z plane, each with its layer and its wall's angle.

nodes         y, z in section axes                                                              [n, 2], m
elements      node indices, counterclockwise seen from +x: 3, 4 (corners), 6 or 8 nodes (corners, then middles of the
              sides 12, 23, ...); one array, or several of different kinds                      [m, k]
layer         which entry of the section's angles and plies an element belongs to               [m]
plane_angle   from y to the wall's tangent s, about +x; None: s runs along the element from node 1 to node 2, also
              where the element is curved                                                       [m], rad

Wall axes are x (along the beam), s = (cos, sin)(plane_angle) and the wall's normal n = x cross s, in which plies are
stacked. At plane_angle 0, (x, s, n) = (x, y, z): a wall is then a plate in the x-y plane, laminate and all.
Bad input is refused here and named by element.
Checked in tests/fem/sections/test_section_mesh.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.mesh.mesh_checks import connected_parts, repeated_rows
from torchmbd.fem.sections.shapes import corners, rule, shape
from torchmbd.math.checked_numbers import indices, reals

KINDS = (3, 4, 6, 8)


class SectionMesh:
    """See the module header. `elements` becomes a tuple of arrays, one for each kind, in the order given.

    dimensions   design variables of its shape: name -> a Parameter, and the derivatives of the nodes with respect to each entry
                 [entries, n, 2]; the nodes are linear in the entries. The sections of generators.py make it
    """

    nodes: Float[Tensor, "n 2"]
    elements: tuple[Int[Tensor, "m k"], ...]
    layer: Int[Tensor, " m"]
    plane_angle: Float[Tensor, " m"] | None
    dimensions: dict[str, tuple[nn.Parameter, Tensor]]

    def __init__(
        self,
        nodes: ArrayLike | Tensor,
        elements: ArrayLike | Tensor | Sequence[ArrayLike | Tensor],
        layer: ArrayLike | Tensor = 0,
        plane_angle: ArrayLike | Tensor | None = None,
    ) -> None:
        self.nodes, self.dimensions = reals("nodes", nodes), {}
        self.elements = tuple(indices("elements", block) for block in _blocks(elements))
        count = sum(len(block) for block in self.elements)
        self.layer = _per_element("layer", indices("layer", layer), count)
        self.plane_angle = None
        if plane_angle is not None:
            self.plane_angle = _per_element("plane_angle", reals("plane_angle", plane_angle), count)
        self._check_nodes()
        self._check_elements()
        self._check_connected()
        self._check_conforming()

    @property
    def layers(self) -> int:
        return int(self.layer.max()) + 1

    def _check_nodes(self) -> None:
        if self.nodes.ndim != 2 or self.nodes.shape[1] != 2 or len(self.nodes) < 3:
            raise InputError(
                "nodes",
                self.nodes,
                "must have shape [n, 2] with n >= 3",
                noun="SectionMesh: nodes",
                state=f"has shape {tuple(self.nodes.shape)}",
            )
        bad = (~torch.isfinite(self.nodes)).any(dim=1).nonzero().flatten()
        if len(bad):
            raise InputError(
                ("nodes", int(bad[0])),
                allowed="finite coordinates",
                state=f"is at {self.nodes[bad[0]].tolist()}",
                noun=f"SectionMesh: node {int(bad[0])}",
            )
        for first, k in repeated_rows(self.nodes.numpy()):
            raise InputError(
                ("nodes", k),
                allowed="apart",
                hint="one node in place of both",
                noun=f"SectionMesh: nodes {first} and {k}",
                state="share one place",
            )
        if self.plane_angle is not None and not torch.isfinite(self.plane_angle).all():
            raise InputError(
                "plane_angle",
                allowed="finite, in rad",
                noun="SectionMesh: plane_angle",
                state="holds numbers that are not finite",
            )
        if self.layer.min() < 0:
            raise InputError(
                "layer",
                int(self.layer.min()),
                "must have layers from 0 up",
                state=f"has layer {int(self.layer.min())}",
                noun="SectionMesh",
            )

    def _check_elements(self) -> None:
        start, n = 0, len(self.nodes)
        used = torch.zeros(n, dtype=torch.bool)
        for block in self.elements:
            if block.ndim != 2 or block.shape[1] not in KINDS or len(block) == 0:
                raise InputError(
                    "elements",
                    allowed=f"must have elements of shape [m, k], k in {KINDS}",
                    state=f"has elements of shape {tuple(block.shape)}",
                    noun="SectionMesh",
                )
            outside = ((block < 0) | (block >= n)).any(dim=1).nonzero().flatten()
            if len(outside):
                k = int(outside[0])
                raise InputError(
                    ("elements", start + k),
                    block[k].tolist(),
                    f"must have nodes from 0 to {n - 1}",
                    state=f"has nodes {block[k].tolist()}",
                    noun=f"SectionMesh: element {start + k}",
                )
            points = torch.cat([rule(block.shape[1])[0], corners(block.shape[1])])
            jacobian = torch.einsum("gki,mkj->mgij", shape(block.shape[1], points)[1], self.nodes[block])
            area = jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
            size = (self.nodes[block].amax(1) - self.nodes[block].amin(1)).amax(1)
            wrong = (area <= 1e-9 * size[:, None] ** 2).any(dim=1).nonzero().flatten()
            if len(wrong):
                k = int(wrong[0])
                raise InputError(
                    ("elements", start + k),
                    block[k].tolist(),
                    "counterclockwise (seen from +x, y to the right) with convex corners",
                    state="is inverted or collapsed",
                    noun=f"SectionMesh: element {start + k}, nodes {block[k].tolist()},",
                )
            used[block.flatten()] = True
            start += len(block)
        if not used.all():
            orphans = (~used).nonzero().flatten().tolist()
            raise InputError(
                "nodes",
                allowed="nodes of elements",
                hint="a mesh without them",
                noun=f"SectionMesh: {len(orphans)} nodes",
                state=f"belong to no element: {orphans[:8]}",
            )

    def _check_connected(self) -> None:
        tail = np.concatenate([block.numpy().ravel() for block in self.elements])
        head = np.concatenate([np.roll(block.numpy(), -1, axis=1).ravel() for block in self.elements])
        parts, stray = connected_parts(tail, head, len(self.nodes))
        if parts > 1:
            raise InputError(
                "elements",
                allowed="one connected part",
                state="is not connected with node 0)",
                noun=f"SectionMesh: {parts} disconnected parts (node {stray}",
            )

    def _check_conforming(self) -> None:
        """Refuse a node in the middle of a side to which it does not belong: the parts would move independently."""
        sides, owner = _sides(self.elements)
        _, inverse, count = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
        rim = np.flatnonzero(count[inverse.ravel()] == 1)
        x, (a, b) = self.nodes.numpy(), sides[rim].T
        outer = np.unique(sides[rim])
        span = x[b] - x[a]
        length = np.linalg.norm(span, axis=1)
        near = KDTree(x[outer]).query_ball_point((x[a] + x[b]) / 2, length * (0.5 - 1e-4))
        k = np.repeat(np.arange(len(rim)), [len(hits) for hits in near])
        node = outer[np.concatenate([np.asarray(hits, dtype=np.int64) for hits in near])]
        offset = x[node] - x[a[k]]
        away = np.abs(span[k, 0] * offset[:, 1] - span[k, 1] * offset[:, 0]) / length[k]
        wrong = np.flatnonzero((away < 1e-6 * length[k]) & (node != a[k]) & (node != b[k]))
        if len(wrong):
            element, stray = int(owner[rim[k[wrong[0]]]]), int(node[wrong[0]])
            raise InputError(
                ("nodes", stray),
                allowed="must have neighbors that share their sides",
                state=f"lies on a side of element {element} and is not one of its nodes",
                noun=f"SectionMesh: node {stray}",
            )


def _sides(elements: Sequence[Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """Node pairs along the sides of all elements (halves of quadratic sides), and the elements that own them."""
    pairs, owner, start = [], [], 0
    for block in elements:
        nodes, k = block.numpy(), block.shape[1]
        ring = nodes if k < 6 else nodes[:, np.arange(k).reshape(2, -1).T.ravel()]  # corner, middle, corner, ...
        pairs.append(np.stack([ring, np.roll(ring, -1, axis=1)], axis=-1).reshape(-1, 2))
        owner.append(np.repeat(np.arange(start, start + len(nodes)), k))
        start += len(nodes)
    return np.concatenate(pairs), np.concatenate(owner)


def _blocks(elements: ArrayLike | Tensor | Sequence[ArrayLike | Tensor]) -> Sequence[ArrayLike | Tensor]:
    """One array for each kind of element: a list whose first item is itself a list of rows, or one array alone."""
    if isinstance(elements, list | tuple) and elements:
        first: Any = elements[0]  # the nodes of an element, or an array of elements
        if first.ndim != 1 if hasattr(first, "ndim") else len(first) and hasattr(first[0], "__len__"):
            return elements
    return [elements]  # pyright: ignore[reportReturnType]


def _per_element(name: str, values: Tensor, count: int) -> Tensor:
    if values.shape not in ((), (count,)):
        shape = tuple(values.shape)
        raise InputError(
            name, allowed="one number, or one for each element", state=f"has shape {shape}", noun=f"SectionMesh: {name}"
        )
    return values.expand(count).clone()
