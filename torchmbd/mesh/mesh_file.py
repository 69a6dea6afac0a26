"""Meshes from files of meshio's formats: gmsh (.msh), Abaqus (.inp), VTK (.vtk, .vtu), and thirty more.

What is read: triangles and quadrilaterals (cut in two); nodes that no element uses are left out (files keep the points
of their geometry). Zones are the named groups of triangles, node sets the named groups of nodes:

    gmsh      physical surfaces; physical points and curves
    Abaqus    *ELSET; *NSET

Elements of second order or in three dimensions are refused: leaving them out would change the structure.
Needs meshio, an optional dependency.
Checked in tests/mesh/test_mesh_file.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.mesh.mesh import Mesh
from torchmbd.mesh.quads import cut_quads

_POINTS_AND_CURVES = ("vertex", "line")  # gmsh writes them for named points and curves


class MeshFile(NamedTuple):
    """A mesh, and the triangles of each named zone."""

    mesh: Mesh
    zones: dict[str, Int[Tensor, " part"]]


def read_mesh(path: str | Path, scale: float = 1.0) -> MeshFile:
    """Read a mesh; scale: meters per unit of the file. InputError tells what cannot be read."""
    try:
        import meshio  # pyright: ignore[reportMissingImports] (optional)
    except ImportError as error:
        raise InputError("reading mesh files needs the package meshio: pip install meshio") from error
    if not Path(path).is_file():
        raise InputError(f"path is {str(path)!r}; allowed: a mesh file that exists")
    if not 0.0 < scale < float("inf"):
        raise InputError(f"scale is {scale!r}; allowed: meters per unit of the file, > 0")
    try:
        found = meshio.read(path)
    except SystemExit as error:  # meshio's readers leave the interpreter on files of an unknown kind
        raise InputError(f"{Path(path).name}: meshio cannot read it") from error
    except (meshio.ReadError, KeyError, ValueError) as error:
        raise InputError(f"{Path(path).name}: meshio cannot read it: {error}") from error
    return mesh_of(found, scale)


def mesh_of(found: Any, scale: float = 1.0) -> MeshFile:
    """Convert a meshio.Mesh."""
    points = torch.from_numpy(np.asarray(found.points, dtype=np.float64)) * scale
    points = torch.cat([points, points.new_zeros(len(points), 3 - points.shape[1])], dim=1)
    triangles, owner = [], []  # owner: (block, cell) of each triangle
    for block, cells in enumerate(found.cells):
        if cells.type in ("triangle", "quad"):
            data = torch.from_numpy(np.asarray(cells.data, dtype=np.int64))
            pieces = data[:, None] if cells.type == "triangle" else cut_quads(points, data)
            triangles.append(pieces.flatten(0, 1))
            own = torch.arange(len(data)).repeat_interleave(pieces.shape[1])
            owner.append(torch.stack([torch.full_like(own, block), own], dim=1))
        elif cells.type not in _POINTS_AND_CURVES:
            raise InputError(f"the mesh has elements {cells.type!r}; allowed: triangle, quad")
    if not triangles:
        raise InputError("the mesh has no triangles or quadrilaterals")
    all_triangles, owners = torch.cat(triangles), torch.cat(owner)
    used, local = torch.unique(all_triangles, return_inverse=True)
    place = torch.full((len(points),), -1, dtype=torch.long)
    place[used] = torch.arange(len(used))
    mesh = Mesh(points[used], local, _node_sets(found, place))
    return MeshFile(mesh, {name: _members(owners, cells) for name, cells in _zones(found).items()})


def _groups(found: Any) -> dict[str, list[np.ndarray]]:
    """Named groups of cells: name -> for each block the numbers of its cells."""
    groups = {
        name: [np.asarray([] if cells is None else cells, dtype=np.int64) for cells in blocks]
        for name, blocks in found.cell_sets.items()
        if not name.startswith("gmsh:") and len(blocks) == len(found.cells)  # Abaqus' sets of sets come mutilated
    }
    for name, (tag, _) in found.field_data.items():
        tags = found.cell_data.get("gmsh:physical")
        if tags is not None and name not in groups:
            groups[name] = [np.flatnonzero(own == tag) for own in tags]
    return groups


def _zones(found: Any) -> dict[str, list[np.ndarray]]:
    flat = [cells.type in ("triangle", "quad") for cells in found.cells]
    return {
        name: blocks
        for name, blocks in _groups(found).items()
        if any(is_flat and len(own) for is_flat, own in zip(flat, blocks, strict=True))
    }


def _members(owners: Tensor, blocks: list[np.ndarray]) -> Tensor:
    inside = torch.zeros(len(owners), dtype=torch.bool)
    for block, cells in enumerate(blocks):
        inside |= (owners[:, 0] == block) & torch.isin(owners[:, 1], torch.from_numpy(cells))
    return torch.nonzero(inside)[:, 0]


def _node_sets(found: Any, place: Tensor) -> dict[str, list[int]]:
    sets = {name: np.asarray(points, dtype=np.int64) for name, points in found.point_sets.items()}
    for name, blocks in _groups(found).items():
        own = [
            np.asarray(cells.data)[members].ravel()
            for cells, members in zip(found.cells, blocks, strict=True)
            if cells.type in _POINTS_AND_CURVES and len(members)
        ]
        if own:
            sets[name] = np.unique(np.concatenate(own))
    mapped = {name: place[torch.from_numpy(points)].tolist() for name, points in sets.items()}
    return {name: [k for k in nodes if k >= 0] for name, nodes in mapped.items() if any(k >= 0 for k in nodes)}
