"""Meshes from files of meshio's formats: gmsh (.msh), Abaqus (.inp), VTK (.vtk, .vtu), and thirty more.

Triangles and quadrilaterals are read, without nodes that no element uses (files have the points of their geometry, too). Zones
are the named groups of cells, node sets the named groups of nodes:

    gmsh      physical surfaces; physical points and curves
    Abaqus    *ELSET; *NSET

Elements of second order or in three dimensions are refused: leaving them out would change the structure; so are keywords of
Abaqus and cards of Nastran that meshio skips and that may be structure (abaqus_file.py, nastran_file.py).
Needs meshio, an optional dependency.
Checked in tests/extensions/meshes/test_mesh_file.py.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchmbd.errors import InputError, not_installed, unknown, within
from torchmbd.extensions.meshes.abaqus_file import AbaqusFile
from torchmbd.extensions.meshes.nastran_file import check_counts, check_nastran, is_nastran
from torchmbd.fem.mesh.mesh import Mesh
from torchmbd.math.checked_numbers import scalar
from torchmbd.math.gradients import constant_arguments
from torchmbd.math.units import factor, units_of

_CELLS = {"triangle": 3, "quad": 4}  # corners
_POINTS_AND_CURVES = ("vertex", "line")  # gmsh writes them for named points and curves


class MeshFile(NamedTuple):
    """A mesh, and the cells of each named zone."""

    mesh: Mesh
    zones: dict[str, Int[Tensor, " part"]]


@constant_arguments
def mesh_file(path: str | Path, scale: float | str = 1.0) -> MeshFile:
    """Read a mesh; scale: meters per unit of the file, or its name, "mm". InputError tells what cannot be read."""
    try:
        import meshio  # pyright: ignore[reportMissingImports] (optional)
    except ImportError as error:
        raise not_installed(
            "path", str(path), "the reader of mesh files", "meshio", "pip install 'torchmbd[mesh]'"
        ) from error
    if not isinstance(path, (str, Path)) or not Path(path).is_file():
        raise InputError("path", str(path), "a mesh file that exists")
    scale = meters("scale", scale)
    path = Path(path)
    abaqus = AbaqusFile(path) if path.suffix.lower() == ".inp" else None
    if is_nastran(path):
        check_nastran(path)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            source = meshio.read(path)
    except SystemExit as error:  # meshio prints the reason and leaves the interpreter
        reason = " ".join(printed.getvalue().split())
        raise _unread(path, reason) from error
    except (
        Exception
    ) as error:  # thirty readers, whose errors on spoilt files are of any kind: IndexError, struct.error, ...
        raise _unread(path, f"{type(error).__name__} {error}") from error
    try:
        if is_nastran(path):
            check_counts(path, source)
        if abaqus is not None:
            abaqus.check_lines(source)
            abaqus.correct_zones(source)
        return mesh_of(source, scale)
    except InputError as error:
        raise within(path.name, error) from None


def _unread(path: Path, reason: str) -> InputError:
    state = f"meshio cannot read it: {reason}"
    return InputError(
        "path", str(path), "a complete file in a format that meshio reads", noun=f"{path.name}:", state=state
    )


@constant_arguments
def mesh_of(source: Any, scale: float = 1.0) -> MeshFile:
    """Convert a meshio.Mesh."""
    points = torch.from_numpy(np.asarray(source.points, dtype=np.float64)) * scale
    if points.ndim != 2 or not 1 <= points.shape[1] <= 3:
        raise InputError(
            "points", allowed="must have shape [n, 2] or [n, 3]", state=f"are an array {list(points.shape)}"
        )
    points = torch.cat([points, points.new_zeros(len(points), 3 - points.shape[1])], dim=1)
    kinds = {kind: [torch.empty(0, width, dtype=torch.long)] for kind, width in _CELLS.items()}
    owner = {kind: [torch.empty(0, 2, dtype=torch.long)] for kind in _CELLS}  # (block, number in it) of each cell
    for block, cells in enumerate(source.cells):
        if cells.type in _CELLS:
            data = torch.from_numpy(np.asarray(cells.data, dtype=np.int64))
            kinds[cells.type].append(data)
            numbers = torch.arange(len(data))
            owner[cells.type].append(torch.stack([torch.full_like(numbers, block), numbers], dim=1))
        elif cells.type not in _POINTS_AND_CURVES:
            raise InputError("elements", cells.type, ("triangle", "quad"), noun="element of the mesh")
    corners = {kind: torch.cat(parts) for kind, parts in kinds.items()}
    used = torch.unique(torch.cat([nodes.flatten() for nodes in corners.values()]))
    if not len(used):
        raise InputError("elements", allowed="must have triangles or quadrilaterals")
    if int(used[0]) < 0 or int(used[-1]) >= len(points):
        raise InputError(
            "cells",
            allowed="must have nodes of the file",
            state=f"have the nodes {int(used[0])} to {int(used[-1])} of {len(points)}",
        )
    new_index = torch.full((len(points),), -1, dtype=torch.long)
    new_index[used] = torch.arange(len(used))
    mesh = Mesh(
        points[used], new_index[corners["triangle"]], _node_sets(source, new_index), quads=new_index[corners["quad"]]
    )
    owners = torch.cat([torch.cat(parts) for parts in owner.values()])
    return MeshFile(mesh, {name: _members(owners, cells) for name, cells in _zones(source).items()})


def _groups(source: Any) -> dict[str, list[np.ndarray]]:
    """Return the named groups of cells: name -> for each block the numbers of its cells."""
    groups = {
        name: [np.asarray([] if cells is None else cells, dtype=np.int64) for cells in blocks]
        for name, blocks in source.cell_sets.items()
        if not name.startswith("gmsh:")
        and len(blocks) == len(source.cells)  # meshio reads Abaqus' sets of sets incompletely
    }
    for name, (tag, _) in source.field_data.items():
        tags = source.cell_data.get("gmsh:physical")
        if tags is not None and name not in groups:
            groups[name] = [np.flatnonzero(tag_numbers == tag) for tag_numbers in tags]
    return groups


def _zones(source: Any) -> dict[str, list[np.ndarray]]:
    flat = [cells.type in _CELLS for cells in source.cells]
    return {
        name: blocks
        for name, blocks in _groups(source).items()
        if any(is_flat and len(members) for is_flat, members in zip(flat, blocks, strict=True))
    }


def _members(owners: Tensor, blocks: list[np.ndarray]) -> Tensor:
    inside = torch.zeros(len(owners), dtype=torch.bool)
    for block, cells in enumerate(blocks):
        inside |= (owners[:, 0] == block) & torch.isin(owners[:, 1], torch.from_numpy(cells))
    return torch.nonzero(inside)[:, 0]


def _node_sets(source: Any, new_index: Tensor) -> dict[str, list[int]]:
    sets = {name: np.asarray(points, dtype=np.int64) for name, points in source.point_sets.items()}
    for name, blocks in _groups(source).items():
        corners = [
            np.asarray(cells.data)[members].ravel()
            for cells, members in zip(source.cells, blocks, strict=True)
            if cells.type in _POINTS_AND_CURVES and len(members)
        ]
        if corners:
            sets[name] = np.unique(np.concatenate(corners))
    mapped = {name: new_index[torch.from_numpy(points)].tolist() for name, points in sets.items()}
    return {name: [k for k in nodes if k >= 0] for name, nodes in mapped.items() if any(k >= 0 for k in nodes)}


def meters(name: str, unit: float | str) -> float:
    """A unit of length as meters: a number > 0, or its name; InputError for anything else."""
    lengths = units_of("m")
    if isinstance(unit, str):
        if unit not in lengths:
            raise unknown(name, unit, lengths)
        return factor(unit)
    x = scalar(name, unit, f"meters per unit, > 0, or one of {', '.join(lengths)}")
    if not x > 0.0:
        raise InputError(name, unit, f"meters per unit, > 0, or one of {', '.join(lengths)}")
    return x
