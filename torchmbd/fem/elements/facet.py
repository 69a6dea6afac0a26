"""Local axes of the cells of a mesh, e1 along the material direction; a warped quadrilateral gets its mean plane.

    e3 = normal (right-hand rule),   e1 = direction - (direction . e3) e3, normalized,   e2 = e3 x e1

axes     rows e1, e2, e3 of each cell: local = axes @ global     [m, 3, 3]
corners  x, y of the corners from their mean, local axes         [m, corners, 2], m
height   of the corners over the plane: 0 for triangles; of a quadrilateral +d, -d, +d, -d     [m, corners], m
area     [m], m2
side_area   mean area of the cells that share each side 12, 23, ...                   [m, corners], m2
mixed    whether cells of different kinds share the side                           [m, corners]
at_boundary whether no other cell lies at the side                                 [m, corners]
tilt     to the smooth shell that the facets stand for, at the worst corner      [m], rad; 0: flat plate

The laminate's x-axis *is* e1, so strains come out in laminate axes and the laminate needs no turning.
The smooth shell's normal at a corner is the mean of the normals of the facets around the node, weighted with their angles
there. Facets that are tilted by more than FEATURE to the facet in question belong to another face of the body (the web of a
box, a stiffener) and do not count, so folds stay folds. Facets of a flat plate get their own normal, to the last digit.
Source: G. Thuermer and C. A. Wuethrich, Computing vertex normals from polygonal facets, J. Graphics Tools 3 (1998).
Checked in tests/fem/elements/test_facet.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.mesh import Mesh
from torchmbd.math.checked_numbers import reals

#: A material direction nearer to the normal than this (sine of the angle) has no reliable projection.
STEEPNESS = 1e-3


@dataclass(frozen=True, eq=False)
class Facets:
    """Cells of one kind in their own planes; see the module header."""

    axes: Float[Tensor, "m 3 3"]
    corners: Float[Tensor, "m corners 2"]
    height: Float[Tensor, "m corners"]
    area: Float[Tensor, " m"]
    side_area: Float[Tensor, "m corners"]
    mixed: Bool[Tensor, "m corners"]
    at_boundary: Bool[Tensor, "m corners"]
    tilt: Float[Tensor, " m"]


def facets(
    mesh: Mesh,
    direction: Sequence[float] | Tensor = (1.0, 0.0, 0.0),
    members: Tensor | None = None,
    kind: str = "triangle",
) -> Facets:
    """Return the cells of one kind, all or `members` (numbers within the kind), in their planes.

    direction: the laminate's x-axis in mesh axes, projected into every cell, [3] or one for each cell of the
    mesh [m, 3].
    Raises InputError if it is zero or normal to a cell.
    """
    d = cell_directions(mesh, direction)
    members = torch.arange(len(mesh.cells[kind])) if members is None else members
    cells = mesh.first_cell(kind) + members
    e3 = mesh.normals[cells]
    axes = _axes(mesh, cells, e3, d[cells])
    p = mesh.nodes[mesh.cells[kind][members]]
    local = (p - p.mean(dim=1, keepdim=True)) @ axes.mT
    tilt = (corner_normals(mesh)[kind][members] - e3[:, None]).norm(dim=2).amax(1)
    side_area, mixed, at_boundary = (of_kind[kind][members] for of_kind in _sides(mesh))
    return Facets(
        axes, local[..., :2].contiguous(), local[..., 2], mesh.areas[cells], side_area, mixed, at_boundary, tilt
    )


def cell_directions(mesh: Mesh, direction: Sequence[float] | Tensor) -> Float[Tensor, "m 3"]:
    """Return the material direction of each cell of the mesh. Raises InputError if its shape is wrong."""
    d = reals("direction", direction)
    if d.shape not in ((3,), (mesh.cell_count, 3)):
        raise InputError(
            "direction",
            d,
            f"must have shape [3], or one for each cell [{mesh.cell_count}, 3]",
            state=f"has shape {tuple(d.shape)}",
        )
    return d.expand(mesh.cell_count, 3)


def _axes(mesh: Mesh, cells: Tensor, e3: Tensor, d: Tensor) -> Float[Tensor, "m 3 3"]:
    length = d.norm(dim=1, keepdim=True)
    e1 = d - (d * e3).sum(1, keepdim=True) * e3
    steep = ((e1.norm(dim=1, keepdim=True) > STEEPNESS * length).logical_not()).flatten().nonzero().flatten()
    if len(steep):
        k = int(steep[0])
        raise InputError(
            "direction",
            allowed="a direction that is not normal to any cell (or one for each cell)",
            state=f"has no projection into {mesh.cell_name(int(cells[k]))}, normal {e3[k].tolist()}",
            noun=f"direction {d[k].tolist()}",
        )
    e1 = e1 / e1.norm(dim=1, keepdim=True)
    return torch.stack([e1, torch.linalg.cross(e3, e1), e3], dim=1)


def _sides(mesh: Mesh) -> tuple[dict[str, Tensor], ...]:
    """Return `side_area`, `mixed` and `at_boundary` of every side of the cells of each kind.

    A side at an edge of the mesh has one cell, a side inside two, more where plates branch.
    """
    numbers = []
    for corners in mesh.cells.values():
        tail, head = corners, corners.roll(-1, dims=1)
        numbers.append((torch.minimum(tail, head) * len(mesh.nodes) + torch.maximum(tail, head)).flatten())
    _, place, count = torch.unique(torch.cat(numbers), return_inverse=True, return_counts=True)
    width = [corners.shape[1] for corners in mesh.cells.values()]
    per_kind = [len(corners) for corners in mesh.cells.values()]
    areas = torch.cat([a.repeat_interleave(w) for a, w in zip(mesh.areas.split(per_kind), width, strict=True)])
    kind = torch.cat([areas.new_full((len(n),), float(k)) for k, n in enumerate(numbers)])
    mean, there = ((x.new_zeros(len(count)).index_add(0, place, x) / count)[place] for x in (areas, kind))
    mixed = there != kind  # the mean of equal whole numbers is that number
    result = [x.split([len(n) for n in numbers]) for x in (mean, mixed, (count == 1)[place])]
    kinds = list(zip(mesh.cells, width, strict=True))
    return tuple({k: x.unflatten(0, (-1, w)) for (k, w), x in zip(kinds, xs, strict=True)} for xs in result)


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
