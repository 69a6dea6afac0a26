"""Normals of the smooth shell that a mesh of flat facets stands for, at the corners of each facet.

The normal at a corner is the mean of the normals of the facets around the node, weighted with their angles there. Facets
that are tilted by more than FEATURE to the facet in question belong to another face of the body (the web of a box, a
stiffener) and do not count, so folds stay folds. Facets of a flat plate get their own normal, to the last digit.
Source: G. Thuermer and C. A. Wuethrich, Computing vertex normals from polygonal facets, J. Graphics Tools 3 (1998).
Checked in tests/fem/elements/test_shell_normals.py.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.mesh import Mesh

#: Facets tilted by more than this angle to each other are not one smooth shell [rad].
FEATURE = math.radians(35.0)


def corner_normals(mesh: Mesh) -> dict[str, Float[Tensor, "m corners 3"]]:
    """Return the unit normal of the smooth shell at every corner of the cells of each kind, mesh axes."""
    kinds = list(mesh.cells.items())
    angle = torch.cat([_angles(mesh.nodes[corners]).flatten() for _, corners in kinds])
    node = torch.cat([corners.flatten() for _, corners in kinds])
    width = torch.cat([torch.full((len(corners),), corners.shape[1]) for _, corners in kinds])
    normals = mesh.normals.repeat_interleave(width, dim=0)  # of every corner's facet
    corner, other = _pairs(node, len(mesh.nodes))
    cosine = (normals[corner] * normals[other]).sum(1)
    smooth = cosine > math.cos(FEATURE)
    # The sum of differences is zero, not rounding, where all facets lie in one plane.
    step = (smooth * angle[other])[:, None] * (normals[other] - normals[corner])
    weight = torch.zeros_like(angle).index_add(0, corner, smooth * angle[other])
    total = normals + torch.zeros_like(normals).index_add(0, corner, step) / weight[:, None]
    total = total / total.norm(dim=1, keepdim=True)
    parts = total.split([corners.numel() for _, corners in kinds])
    return {kind: part.unflatten(0, corners.shape) for (kind, corners), part in zip(kinds, parts, strict=True)}


def _angles(p: Tensor) -> Float[Tensor, "m corners"]:
    """Angles of cells at their corners."""
    ahead, back = p.roll(-1, dims=1) - p, p.roll(1, dims=1) - p
    return torch.atan2(torch.linalg.cross(ahead, back).norm(dim=2), (ahead * back).sum(2))


def _pairs(node: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """All ordered pairs of corners that share a node, each corner with itself among them."""
    order = torch.argsort(node, stable=True)
    count = torch.bincount(node, minlength=n)
    first = count.cumsum(0) - count
    pairs = count[node]
    corner = torch.repeat_interleave(pairs)
    within = torch.arange(len(corner)) - (pairs.cumsum(0) - pairs)[corner]
    return corner, order[first[node[corner]] + within]
