"""The reference nodes of a flexible body: those that are fixed to its frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine, Follower, Part
from torchmbd.fem.mesh import Mesh
from torchmbd.multibody.bodies.interpolation import node_indices


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
    nodes = node_indices(mesh, reference)
    if not nodes:
        raise InputError(f"reference is {reference!r}; allowed: a node, a node set or a list of at least one node")
    return nodes
