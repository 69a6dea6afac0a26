"""Normals of the smooth shell that a mesh of flat facets stands for, at the corners of each facet.

The normal at a corner is the mean of the normals of the facets around the node, weighted with their angles there. Facets
that are tilted by more than FEATURE to the facet in question belong to another face of the body (the web of a box, a
stiffener) and do not count, so folds stay folds. Facets of a flat plate get their own normal, to the last digit.
Source: G. Thuermer and C. A. Wuethrich, Computing vertex normals from polygonal facets, J. Graphics Tools 3 (1998).
Checked in tests/elements/test_shell_normals.py.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.mesh import Mesh

#: Facets tilted by more than this angle to each other are not one smooth shell [rad].
FEATURE = math.radians(35.0)


def corner_normals(mesh: Mesh) -> Float[Tensor, "m 3 3"]:
    """Return the unit normal [triangle, corner, mesh axes] of the smooth shell at every corner."""
    normals, m = mesh.normals, len(mesh.triangles)
    angle = _angles(mesh.nodes[mesh.triangles]).flatten()
    own, other = _pairs(mesh.triangles.flatten(), len(mesh.nodes))
    a, b = torch.div(own, 3, rounding_mode="floor"), torch.div(other, 3, rounding_mode="floor")
    cosine = (normals[a] * normals[b]).sum(1)
    smooth = cosine > math.cos(FEATURE)
    # The sum of differences is zero, not rounding, where all facets lie in one plane.
    step = (smooth * angle[other])[:, None] * (normals[b] - normals[a])
    weight = angle.new_zeros(3 * m).index_add(0, own, smooth * angle[other])
    tilt = angle.new_zeros(3 * m, 3).index_add(0, own, step) / weight[:, None]
    total = normals.repeat_interleave(3, dim=0) + tilt
    return (total / total.norm(dim=1, keepdim=True)).unflatten(0, (m, 3))


def _angles(p: Tensor) -> Float[Tensor, "m 3"]:
    """Angles of triangles at their corners."""
    ahead, back = p.roll(-1, dims=1) - p, p.roll(1, dims=1) - p
    return torch.atan2(torch.linalg.cross(ahead, back).norm(dim=2), (ahead * back).sum(2))


def _pairs(node: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """All ordered pairs of corners that share a node, each corner with itself among them."""
    order = torch.argsort(node, stable=True)
    count = torch.bincount(node, minlength=n)
    first = count.cumsum(0) - count
    pairs = count[node]
    own = torch.repeat_interleave(pairs)
    within = torch.arange(len(own)) - (pairs.cumsum(0) - pairs)[own]
    return own, order[first[node[own]] + within]
