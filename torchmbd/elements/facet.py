"""Local axes of flat triangles in space, laid along the material direction.

    e3 = normal (right-hand rule),   e1 = direction - (direction . e3) e3, normalized,   e2 = e3 x e1

axes     rows e1, e2, e3 of each triangle: local = axes @ global     [m, 3, 3]
corners  x, y of the three corners from the centroid, local axes     [m, 3, 2], m
area     [m], m2
cell     mean area of the triangles that share each side 12, 23, 31                     [m, 3], m2
tilt     to the smooth shell that the facets stand for, at the worst corner (shell_normals.py)   [m], rad; 0: flat plate

The laminate's x-axis *is* e1, so strains come out in laminate axes and the laminate needs no turning.
Checked in tests/elements/test_facet.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.elements.shell_normals import corner_normals
from torchmbd.errors import InputError
from torchmbd.mesh import Mesh

#: A material direction nearer to the normal than this (sine of the angle) has no reliable projection.
STEEPNESS = 1e-3


@dataclass(frozen=True, eq=False)
class Facets:
    """The triangles of a mesh in their own planes; see the module header."""

    axes: Float[Tensor, "m 3 3"]
    corners: Float[Tensor, "m 3 2"]
    area: Float[Tensor, " m"]
    cell: Float[Tensor, "m 3"]
    tilt: Float[Tensor, " m"]


def facets(mesh: Mesh, direction: Sequence[float] | Tensor = (1.0, 0.0, 0.0), members: Tensor | None = None) -> Facets:
    """Lay the triangles of a mesh, or those named by `members`, into their planes.

    direction: the laminate's x-axis in mesh axes, projected into every triangle, [3] or one for each triangle of the
    mesh [m, 3].
    Raises InputError where it is zero or normal to a triangle.
    """
    d = torch.as_tensor(direction, dtype=torch.float64)
    if d.shape not in ((3,), (len(mesh.triangles), 3)):
        raise InputError(f"direction has shape {tuple(d.shape)}; allowed: [3], or one for each triangle [m, 3]")
    members = torch.arange(len(mesh.triangles)) if members is None else members
    e3 = mesh.normals[members]
    d = d.expand_as(e3) if d.ndim == 1 else d[members]
    length = d.norm(dim=1, keepdim=True)
    e1 = d - (d * e3).sum(1, keepdim=True) * e3
    steep = ((e1.norm(dim=1, keepdim=True) > STEEPNESS * length).logical_not()).flatten().nonzero().flatten()
    if len(steep):
        k = int(steep[0])
        raise InputError(
            f"direction {d[k].tolist()} has no projection into triangle {int(members[k])}, normal {e3[k].tolist()}; "
            "allowed: a direction that is not normal to any triangle (or one for each triangle)"
        )
    e1 = e1 / e1.norm(dim=1, keepdim=True)
    axes = torch.stack([e1, torch.linalg.cross(e3, e1), e3], dim=1)
    p = mesh.nodes[mesh.triangles[members]]
    corners = (p - p.mean(dim=1, keepdim=True)) @ axes.mT
    tilt = (corner_normals(mesh) - mesh.normals[:, None]).norm(dim=2).amax(1)[members]
    return Facets(axes, corners[..., :2].contiguous(), mesh.areas[members], _cells(mesh)[members], tilt)


def _cells(mesh: Mesh) -> Float[Tensor, "m 3"]:
    """Mean area of the triangles at each side: one at an edge of the mesh, two inside, more where plates branch."""
    tail, head = mesh.triangles, mesh.triangles.roll(-1, dims=1)
    sides = torch.minimum(tail, head) * len(mesh.nodes) + torch.maximum(tail, head)
    _, place, count = torch.unique(sides.flatten(), return_inverse=True, return_counts=True)
    areas = mesh.areas.repeat_interleave(3)
    return (areas.new_zeros(len(count)).index_add(0, place, areas) / count)[place].unflatten(0, (-1, 3))
