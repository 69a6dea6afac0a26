"""Interpolation constraints: the motion of a frame on several nodes of a flexible body is a mean of their motions.

    c = sum w x,  d = x - c                            w: weights of the nodes, sum 1
    u = sum w u_k                                      displacement of the center c
    T th = sum w d x u_k,  T = sum w (d'd 1 - d d')    rotation: least squares of sum w |u_k - u - th x d|^2
    th += N N' sum w th_k                              N: null space of T

Displacements of nodes on one line do not determine the rotation about it, and those of a single node none at all: these are the
mean of the rotations of the nodes. So a frame on one node has its motion. Forces on the frame are distributed to the nodes by
the transpose. Rigid sets of nodes are an argument of the body (`rigid`), not of the frame.
Source: the interpolation element RBE3 of Nastran.
Checked in tests/multibody/bodies/test_interpolation.py.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, within
from torchmbd.fem.elements import BeamLine, Follower, Part, RigidLink
from torchmbd.fem.mesh import Mesh
from torchmbd.math.checked_numbers import scalar

_FLAT = 1e-10  # share of the largest eigenvalue of T that counts as zero


@dataclass(frozen=True)
class InterpolationConstraint:
    """Nodes with weights; see the module header. Hashable: equal constraints are one key."""

    nodes: tuple[int, ...]
    weights: tuple[float, ...]

    @classmethod
    def on(cls, nodes: Sequence[int], weights: Sequence[float] | None = None) -> InterpolationConstraint:
        """The constraint of nodes with positive weights, which are normalized to the sum 1; None: equal weights."""
        allowed = "a positive number for each node"
        if weights is not None and (
            isinstance(weights, str) or not isinstance(weights, (Sequence, Tensor, np.ndarray))
        ):
            raise InputError("weights", weights, allowed)
        numbers = [1.0] * len(nodes) if weights is None else [scalar("weights", w, allowed) for w in weights]
        if len(numbers) != len(nodes) or not nodes or not all(0.0 < w < float("inf") for w in numbers):
            raise InputError("weights", weights, allowed, state=f"is {weights!r} for {len(nodes)} nodes")
        return cls(tuple(nodes), tuple(w / sum(numbers) for w in numbers))

    def center(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, " 3"]:
        """Center of the nodes of a mesh with positions x [m]."""
        return (self._w(x)[:, None] * x[..., list(self.nodes), :]).sum(-2)

    def motion(self, x: Float[Tensor, "n 3"], psi: Float[Tensor, "*lanes n 6 m"]) -> Float[Tensor, "*lanes 6 m"]:
        """Translation of the center and rotation, out of the motion psi of all nodes."""
        motion = psi[..., list(self.nodes), :, :]
        if len(self.nodes) == 1:
            return motion[..., 0, :, :]
        u_k, th_k = motion[..., :3, :], motion[..., 3:, :]
        w = self._w(x)
        d = x[list(self.nodes)] - self.center(x)
        u = torch.einsum("k,...kim->...im", w, u_k)
        squares = torch.einsum("k,kij->ij", w, (d * d).sum(1)[:, None, None] * torch.eye(3, dtype=x.dtype))
        values, axes = torch.linalg.eigh(squares - d.T @ (w[:, None] * d))  # of T
        determined = values > _FLAT * values[-1]
        moment = torch.linalg.cross(d[:, :, None].expand_as(u_k), u_k, dim=-2)
        inverse = (axes[:, determined] / values[determined]) @ axes[:, determined].T
        turn = torch.einsum("ij,k,...kjm->...im", inverse, w, moment)
        N = axes[:, ~determined]
        turn = turn + torch.einsum("ij,k,...kjm->...im", N @ N.T, w, th_k)
        return torch.cat([u, turn], dim=-2)

    def nearest(self, x: Float[Tensor, "n 3"], point: Float[Tensor, " 3"]) -> int:
        """The node of the constraint that is nearest to a point."""
        return self.nodes[int((x[list(self.nodes)] - point).norm(dim=1).argmin())]

    def _w(self, x: Tensor) -> Tensor:
        return torch.tensor(self.weights, dtype=x.dtype)


def node_indices(mesh: Any, nodes: str | int | Sequence[str | int]) -> list[int]:
    """Indices of a node, of a node set, or of a list of nodes."""
    if isinstance(nodes, str) and len(mesh.node_sets.get(nodes, ())) > 1:
        return [int(i) for i in mesh.node_sets[nodes]]
    arrays = isinstance(nodes, (Tensor, np.ndarray)) and nodes.ndim > 0
    several = (arrays or isinstance(nodes, Sequence)) and not isinstance(nodes, str) and not _whole(nodes)
    return [_index(mesh, node) for node in (nodes if several else [nodes])]  # pyright: ignore


def _index(mesh: Any, node: Any) -> int:
    if isinstance(node, str):
        return mesh.node(node)
    if not _whole(node) or not 0 <= int(node) < len(mesh.nodes):
        raise InputError("node", node, f"a node name or 0 to {len(mesh.nodes) - 1}")
    return int(node)


def _whole(x: Any) -> bool:
    try:
        operator.index(x)  # hasattr(x, "__index__") is true for arrays of several entries too
    except TypeError:
        return False
    return True


def rigid_links(mesh: Any, sets: Sequence[str | Sequence[int]]) -> list[RigidLink]:
    """Links that make each set of nodes one rigid body, all of whose nodes follow the first."""
    if isinstance(sets, str) or not isinstance(sets, Sequence):
        raise InputError("rigid", sets, "a list of node sets, such as ['left_edge']")
    links = []
    for node_set in sets:
        leader, *others = node_indices(mesh, node_set)
        if not others:
            raise InputError(
                "rigid", allowed="must have sets of at least two nodes", state=f"has the set {node_set!r} of one node"
            )
        links += [RigidLink(node, leader) for node in others]
    return links


def reference_nodes(
    mesh: Mesh | BeamLine,
    parts: Mapping[str, Part],
    reference: str | int | Sequence[int] | None,
    links: Sequence[Follower],
) -> list[int]:
    """Indices of the given nodes; None: the node nearest to the center of mass that is free to be held."""
    if reference is None:
        points = [part.masses() for part in parts.values()]
        x = torch.cat([mesh.nodes[p.ends].mean(1) + (0.0 if p.arm is None else p.arm.detach()) for p in points])
        m = torch.cat([p.mass for p in points]).detach()
        center = (m[:, None] * x).sum(0) / m.sum()
        distance = ((mesh.nodes - center) ** 2).sum(1)
        distance[[link.node for link in links]] = torch.inf  # a node that follows cannot be held
        return [int(distance.argmin())]
    try:
        nodes = node_indices(mesh, reference)
    except InputError as error:
        raise within("reference", error) from None
    if not nodes:
        raise InputError("reference", reference, "a node, a node set or a list of at least one node")
    return nodes
