"""A warning, once for each body, of cells or plies for which the shell elements are not accurate.

skewed cells   a corner of a quadrilateral below 30 or above 150 degrees, of a triangle above 160: MSC Nastran's GEOMCHECK
slender cells  of 12 : 1 and more: drilling rotations get frequencies among those of bending
               (tests/fem/elements/test_slender_cells.py)
stiff fibers   E1 / E2 or E1 / G of a ply of 1e4 and more on fewer than 1500 cells: the layers along its fibers are not
               resolved. A strip 6 : 1 whose fibers slant by 15 or 45 degrees bends by 0.36 and 0.55 of what it does with
               96x16 quadrilaterals where it has 12x2, by 0.56 and 0.66 with 24x4, by 0.82 with 48x8

Checked in tests/multibody/bodies/test_mesh_quality.py.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.fem.elements import Part, Plates
from torchmbd.fem.mesh import directed_area
from torchmbd.math.variable import without_variables

CORNERS = {"quad": (30.0, 150.0), "triangle": (0.0, 160.0)}  # degrees
ASPECT = 12.0
ANISOTROPY, FINE = 1e4, 1500  # ratio of moduli; cells
_ROUNDING = 1e-9


def warn_mesh(name: str, parts: Iterable[Part]) -> None:
    """Warn once, naming the worst cell and its figure, if cells are skewed or slender or too coarse for their plies."""
    faults = [fault for part in parts if isinstance(part, Plates) for fault in (*_cells(part), *_plies(part))]
    if faults:
        warn(
            f"mesh of body {name!r}: {'; '.join(faults)}. Results may be inaccurate. Try: a finer mesh, or cells with corners "
            f"of {CORNERS['quad'][0]:g} to {CORNERS['quad'][1]:g} degrees and an aspect ratio below {ASPECT:g}",
        )


def corner_angles(p: Float[Tensor, "m c 3"]) -> Float[Tensor, "m c"]:
    """Angles of cells at their corners [degrees]."""
    ahead, back = p.roll(-1, dims=1) - p, p.roll(1, dims=1) - p
    return torch.rad2deg(torch.atan2(torch.linalg.cross(ahead, back).norm(dim=2), (ahead * back).sum(2)))


def aspects(p: Float[Tensor, "m c 3"]) -> Float[Tensor, " m"]:
    """Length over width: of the lines that halve a quadrilateral; of a triangle, its longest side over the height on it."""
    if p.shape[1] == 3:
        longest2 = (p.roll(-1, dims=1) - p).square().sum(2).amax(1)
        return longest2 / (2.0 * directed_area(p).norm(dim=1))
    middles = (p + p.roll(-1, dims=1)) / 2.0
    length, width = ((middles[:, k] - middles[:, k + 2]).norm(dim=1) for k in (0, 1))
    return torch.maximum(length / width, width / length)


def _cells(part: Plates) -> list[str]:
    mesh, kinds, messages = part.matrices.mesh, part.matrices.kinds, []
    members = part.matrices.members.split([len(cells.corners) for cells in kinds.values()])
    for (kind, cells), number in zip(kinds.items(), members, strict=True):
        p = mesh.nodes[cells.corners]
        angles, slender = corner_angles(p), aspects(p)
        least, most = CORNERS[kind]
        excess, corner = torch.maximum(least - angles, angles - most).max(1)
        skewed, long = excess > _ROUNDING * most, slender >= ASPECT * (1.0 - _ROUNDING)
        if skewed.any():
            k = int(excess.argmax())
            name, angle = mesh.cell_name(int(number[k])), float(angles[k, corner[k]])
            messages.append(f"{int(skewed.sum())} skewed cells, such as {name} with a corner of {angle:.1f} degrees")
        if long.any():
            k = int(slender.argmax())
            name = mesh.cell_name(int(number[k]))
            messages.append(f"{int(long.sum())} slender cells, such as {name} of {float(slender[k]):.1f} : 1")
    return messages


def _plies(part: Plates) -> list[str]:
    count = len(part.matrices.members)
    plies = [without_variables(p) for p in part.laminates[0].plies]
    ratios = [max(p.E1, p.E2) / min(p.E1, p.E2, p.G12, p.G13, p.G23) for p in plies]
    k = max(range(len(ratios)), key=ratios.__getitem__)
    if ratios[k] < ANISOTROPY or count >= FINE:
        return []
    return [f"ply {k} has E1 / E2 or E1 / G = {ratios[k]:.3g} on {count} cells, where {FINE} are few"]
