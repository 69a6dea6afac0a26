"""From a Nastran model to a mesh: cells with the direction of their material, zones by property, named nodes.

node sets   "grid_12", "spc_1" (of set 1; "spc_0": what GRIDs hold themselves), "conm2_7", "rbe2_30" and "rbe3_31" (the
            grid where a frame may sit)
direction   x axis of the laminate: the first side of the element turned by THETA, or the x axis of a system (MCID;
            of a cylindrical one the radius at the element's middle)

Grids at one place stay apart: what the file does not join is not joined. Grids of no element are left out, and listed.
Checked in tests/extensions/nastran/test_mesh.py.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError, warn, wrong_entry
from torchmbd.extensions.nastran.bars import BarLines, bar_lines
from torchmbd.extensions.nastran.data import READ, BulkData, Shell
from torchmbd.fem.mesh.mesh import Mesh


class BulkMesh(NamedTuple):
    """The mesh of a model.

    zones      cells by property and ZOFFS
    direction  x axis of the laminate in each cell
    index      node of each GRID number
    bars       lines of bars, whose own nodes follow those of grids
    """

    mesh: Mesh
    zones: dict[tuple[int, float], Int[Tensor, " part"]]
    direction: Float[Tensor, "m 3"]
    index: dict[int, int]
    bars: BarLines


def bulk_mesh(data: BulkData, length: float = 1.0) -> BulkMesh:
    """Make the mesh of a model; `length`: meters per unit of the file."""
    index = {grid: k for k, grid in enumerate(_used(data))}
    nodes = torch.tensor([data.grids[grid] for grid in index], dtype=torch.float64).reshape(-1, 3) * length
    bars = bar_lines(data, index)
    nodes = torch.cat([nodes, torch.from_numpy(np.array(bars.places)).reshape(-1, 3) * length])
    shells = sorted(data.shells, key=lambda shell: len(shell.grids))  # triangles first, else in the order of the file
    corners = [[index[grid] for grid in shell.grids] for shell in shells]
    lines = [*bars.nodes, *bars.followed]
    rings = [(*element.grids, element.grids[0]) for element in (*data.solids, *data.panels)]
    lines += [(index[a], index[b]) for ring in rings for a, b in itertools.pairwise(ring)]
    lines += [(index[link.grids[0]], index[link.grids[1]]) for link in data.links]
    lines += [(index[rigid.grid], index[other]) for rigid in data.rigids for other in rigid.others]
    lines += [
        (index[constraint.grids[0]], index[other]) for constraint in data.constraints for other in constraint.grids[1:]
    ]
    mesh = Mesh(
        nodes,
        _cells(corners, 3),
        _names(data, index),
        torch.tensor(lines, dtype=torch.long).reshape(-1, 2),
        [*(str(data.grid_cards[grid]) for grid in index), *bars.names],
        [str(shell.card) for shell in shells],
        _cells(corners, 4),
        as_given=True,
    )
    directions = torch.tensor([_direction(data, shell) for shell in shells], dtype=torch.float64).reshape(-1, 3)
    members: dict[tuple[int, float], list[int]] = {}
    for k, shell in enumerate(shells):
        members.setdefault((shell.property, shell.offset), []).append(k)
    zones = {key: torch.tensor(members[key], dtype=torch.long) for key in sorted(members)}
    return BulkMesh(mesh, zones, directions, index, bars)


def _used(data: BulkData) -> list[int]:
    """Grids of elements, rigid elements and masses, in the order of their cards."""
    used = {
        grid
        for element in (*data.shells, *data.bars, *data.solids, *data.panels, *data.links)
        for grid in element.grids
    }
    used |= {grid for tied in (*data.rigids, *data.constraints) for grid in tied.grids}
    if not (data.shells or data.bars or data.solids or data.panels or data.links):
        raise InputError(
            "elements",
            allowed=f"must have at least one of {', '.join(READ)}",
            state="has no elements that can be read",
            noun="the file",
        )
    oriented = {bar.card.integer(5, "G0") for bar in data.bars if bar.card.text(5).isdigit()}
    stray = len(data.grids.keys() - used - oriented)
    if stray:
        data.ignored["GRID of no element"] += stray
    loose = [mass for mass in data.masses if mass.grid not in used]
    if loose:
        total = sum(mass.mass for mass in loose)
        warn(
            f"{loose[0].card}: no element is attached to its grid; torchmbd leaves out {len(loose)} CONM2 with a total mass "
            f"of {total:g}"
        )
        data.masses[:] = [mass for mass in data.masses if mass.grid in used]
    return [grid for grid in data.grids if grid in used]


def _cells(corners: list[list[int]], count: int) -> Tensor:
    return torch.tensor([nodes for nodes in corners if len(nodes) == count], dtype=torch.long).reshape(-1, count)


def _direction(data: BulkData, shell: Shell) -> list[float]:
    p = torch.tensor([data.grids[grid] for grid in shell.grids], dtype=torch.float64)
    if shell.system is not None:
        return data.systems.axes(shell.system, shell.card, p.mean(0).numpy())[0].tolist()
    side = p[1] - p[0]
    normal = torch.linalg.cross(p[2] - p[0], (p[3] if len(p) == 4 else p[2]) - p[1])
    size = normal.norm()
    if float(size) == 0.0:
        raise wrong_entry(shell.card, "is collapsed (its corners are on a line)", key="G")
    normal = normal / size
    side = side - (side @ normal) * normal
    theta = math.radians(shell.theta or 0.0)
    return (math.cos(theta) * side + math.sin(theta) * torch.linalg.cross(normal, side)).tolist()


def _names(data: BulkData, index: dict[int, int]) -> dict[str, list[int]]:
    sets = {f"grid_{grid}": [k] for grid, k in index.items()}
    for support in data.supports:
        nodes = sets.setdefault(f"spc_{support.set}", [])
        nodes += [index[grid] for grid in support.grids if grid in index and index[grid] not in nodes]
    for item in (*data.masses, *data.rigids):
        sets[f"{item.card.name.lower()}_{item.card.integer(1, 'EID')}"] = [index[item.grid]]
    return sets
