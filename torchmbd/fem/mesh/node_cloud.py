"""Nodes without elements: those of a body whose matrices come from outside. Lines are for pictures only."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchmbd.errors import InputError
from torchmbd.fem.mesh.mesh import Mesh


@dataclass(frozen=True, eq=False, repr=False)
class NodeCloud(Mesh):
    """A Mesh of nodes [n, 3] [m] with names, and lines between some; nodes may share a place."""

    def __repr__(self) -> str:
        return f"NodeCloud({len(self.nodes)} nodes)"

    def _check(self) -> None:
        nodes = self.nodes
        if nodes.ndim != 2 or nodes.shape[1] != 3 or not len(nodes) or not bool(torch.isfinite(nodes).all()):
            raise InputError(f"nodes have shape {tuple(nodes.shape)}; allowed: finite numbers [n, 3]")
        for name, members in {"lines": self.lines.flatten().tolist(), **self.node_sets}.items():
            for k in members:
                if not 0 <= k < len(nodes):
                    raise InputError(f"{name!r} has node {k}; allowed: 0 to {len(nodes) - 1}")
