"""Open thin-walled profiles by dimension: C, L, Z, hat and T, with a laminate for each wall.

Walls of C, L, Z and hat follow one another with right angles; their plies meet on the diagonals of the corners. The middle of
the walls is a path of points P with directions d and normals n to their left:

    face at a distance a from the middle:   P + a (n1 + n2) at corners, P + a n at the ends

Plies are listed along n: from inside to outside of C, L and hat, from the right to the left of a Z's web, from bottom to top of
a T's flange. The wall's tangent s = d, and the ply angle is counted from x to s.
All lengths in m, angles in rad; the origin is the center of the outer dimensions. Corners are sharp.
Widths, heights and thicknesses may be Parameters (mbd.variable): design variables of the section by these names.
Checked in tests/fem/sections/test_profiles.py: against closed forms of thin walls.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials.ply import Lamina
from torchmbd.fem.sections.generators import (
    Angles,
    Plies,
    Varying,
    check_cells,
    check_lengths,
    check_names,
    checked_thicknesses,
    count_of_layers,
)
from torchmbd.fem.sections.orthotropic import Orthotropic
from torchmbd.fem.sections.patches import Patch, between, graded, grid, line, parametric_mesh
from torchmbd.fem.sections.section import Section
from torchmbd.math.gradients import constant_arguments
from torchmbd.math.variable import number

Walls = Angles | Mapping[str, Angles]
_RIGHT, _LEFT, _UP, _DOWN = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)
# Along each wall and through each ply: torsion within 1 % of its limit.
_CELLS = (12, 1)


@constant_arguments
def c_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Walls,
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
) -> Section:
    """A channel that opens to +y: outer width of its flanges, outer height of its web.

    angles     of the plies from inside to outside, in all walls; or {"bottom": ..., "web": ..., "top": ...}, which makes the
               section's angles those of bottom, web, top, one after the other. All walls have as many plies
    thickness  of every ply, or one for each ply of a wall
    cells      along each wall, through each ply

    >>> section = mbd.sections.c_section(0.03, 0.06, mbd.examples.carbon(), mbd.deg([0, 45]), thickness=1e-3, cells=(4, 1))
    >>> round(section.mass()[0, 0].item() / 1586.0 * 1e6, 6)  # area: 2 mm x (60 + 2 x 28) mm
    232.0
    """

    def path(t: Any, width: Any, height: Any) -> list[tuple]:
        y, z = (t - width) / 2, (height - t) / 2
        return [(width / 2, -z), (y, -z), (y, z), (width / 2, z)]

    walls = {"bottom": _LEFT, "web": _UP, "top": _RIGHT}
    return _chain(
        "c_section", walls, path, {"width": width, "height": height}, (1, 2), ply, angles, thickness, cells, order
    )


@constant_arguments
def l_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Walls,
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
) -> Section:
    """An angle with its corner at the lower left: outer width and height; walls "bottom" and "left".

    Others as of `c_section`.
    """

    def path(t: Any, width: Any, height: Any) -> list[tuple]:
        y, z = (t - width) / 2, (t - height) / 2
        return [(width / 2, z), (y, z), (y, height / 2)]

    walls = {"bottom": _LEFT, "left": _UP}
    return _chain(
        "l_section", walls, path, {"width": width, "height": height}, (1, 1), ply, angles, thickness, cells, order
    )


@constant_arguments
def z_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Walls,
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
) -> Section:
    """A Z: outer width of each flange with the web, outer height; walls "bottom" (to +y), "web", "top" (to -y).

    Others as of `c_section`.
    """

    def path(t: Any, width: Any, height: Any) -> list[tuple]:
        y, z = width - t / 2, (height - t) / 2
        return [(y, -z), (0.0 * y, -z), (0.0 * y, z), (-y, z)]

    walls = {"bottom": _LEFT, "web": _UP, "top": _LEFT}
    return _chain(
        "z_section", walls, path, {"width": width, "height": height}, (1, 2), ply, angles, thickness, cells, order
    )


@constant_arguments
def hat_section(
    width: float | Tensor,
    crown: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Walls,
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
) -> Section:
    """A hat that opens to -z: width from foot to foot, outer width of its crown, outer height.

    Walls "left_foot", "left_web", "crown", "right_web", "right_foot". Others as of `c_section`.
    """
    if not number(crown) < number(width):
        raise InputError(
            "crown",
            number(crown),
            rule=f"must be less than the width {number(width):g} m",
            noun="hat_section: crown",
            shown=f"{number(crown):g} m",
        )

    def path(t: Any, width: Any, crown: Any, height: Any) -> list[tuple]:
        y, z = (crown - t) / 2, (height - t) / 2
        return [(-width / 2, -z), (-y, -z), (-y, z), (y, z), (y, -z), (width / 2, -z)]

    walls = {"left_foot": _RIGHT, "left_web": _UP, "crown": _RIGHT, "right_web": _DOWN, "right_foot": _RIGHT}
    lengths = {"width": width, "crown": crown, "height": height}
    return _chain("hat_section", walls, path, lengths, (2, 2, 2), ply, angles, thickness, cells, order)


@constant_arguments
def t_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Walls,
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
) -> Section:
    """A T: width of its flange "top", whole height; the plies of its "web" from left to right. Others as of `c_section`.

    cells   along each half of the flange and along the web, through each ply
    """
    names = ("top", "web")
    lengths = {"width": width, "height": height}
    layers, of_walls, plies, section_angles = _laminates(
        "t_section", names, lengths, (1, 1), ply, angles, thickness, cells, order
    )

    def build(width: Any, height: Any, thickness: Any) -> list[Patch]:
        t = np.broadcast_to(thickness, layers)
        faces = np.concatenate([[0.0], np.cumsum(t)]) - t.sum() / 2
        across = [line(a, b, cells[1], order) for a, b in pairwise(faces)]  # of the web, and of the flange above it
        free = [graded(-width / 2, faces[0], cells[0], order), graded(faces[-1], width / 2, cells[0], order)]
        middle, patches = (height - t.sum()) / 2, []
        for k in range(layers):
            z = line(middle + faces[k], middle + faces[k + 1], cells[1], order)
            patches += [Patch(grid(y, z), of_walls[0] + k) for y in (*free, *across)]
        web = graded(height / 2 - t.sum(), -height / 2, cells[0], order)
        return patches + [Patch(grid(across[k], web).transpose(1, 0, 2), of_walls[1] + k) for k in range(layers)]

    return Section(parametric_mesh(build, lengths | {"thickness": thickness}, order), plies, section_angles)


def _laminates(
    kind: str,
    names: Sequence[str],
    lengths: Mapping[str, Any],
    least: Sequence[int],
    ply: Plies,
    angles: Walls,
    thickness: Varying,
    cells: tuple[int, int],
    order: int,
) -> tuple[int, list[int], Any, Any]:
    """Plies of a wall, the first layer of each wall, plies and angles of the section; InputError names what does not fit.

    least   walls that each length has to be larger than
    """
    check_lengths(**lengths)
    check_cells(cells, 2, order)
    if isinstance(angles, Mapping):
        check_names(angles, names)
    layers = count_of_layers(angles[names[0]] if isinstance(angles, Mapping) else angles)
    total = checked_thicknesses(thickness, layers).sum()
    for (name, length), walls in zip(lengths.items(), least, strict=True):
        if not walls * total < number(length):
            limit = "the thickness" if walls == 1 else f"{walls} times the thickness"
            raise InputError(
                (str(kind), name),
                number(length),
                rule=f"must be more than {limit} {total:g} m of a wall",
                hint="thinner or fewer plies",
                noun=f"{kind}: {name}",
                shown=f"{number(length):g} m",
            )
    if not isinstance(angles, Mapping):
        return layers, [0] * len(names), ply, angles
    plies = ply if isinstance(ply, Lamina | Orthotropic) else list(ply) * (len(names) if len(ply) == layers else 1)
    of_all = np.concatenate([np.asarray(angles[name]) for name in names]).tolist()
    return layers, [k * layers for k in range(len(names))], plies, of_all


def _chain(
    kind: str,
    walls: Mapping[str, tuple[float, float]],
    path: Callable[..., list[tuple]],
    lengths: dict[str, Any],
    least: Sequence[int],
    ply: Plies,
    angles: Walls,
    thickness: Varying,
    cells: tuple[int, int],
    order: int,
) -> Section:
    """A section whose walls follow one another.

    walls   name -> direction;  path: their points in the middle, of the thickness of a wall and the lengths
    """
    layers, of_walls, plies, section_angles = _laminates(
        kind, list(walls), lengths, least, ply, angles, thickness, cells, order
    )
    normals = [np.array((-z, y)) for y, z in walls.values()]
    at_points = [normals[0], *(a + b for a, b in pairwise(normals)), normals[-1]]

    def build(thickness: Any, **lengths: Any) -> list[Patch]:
        t = np.broadcast_to(thickness, layers)
        faces = np.concatenate([[0.0], np.cumsum(t)]) - t.sum() / 2
        points = [np.array(point) for point in path(t.sum(), **lengths)]
        share, patches = graded(0.0, 1.0, cells[0], order)[:, None], []
        for w, first in enumerate(of_walls):
            for k in range(layers):
                low, high = (
                    (1.0 - share) * (points[w] + a * at_points[w]) + share * (points[w + 1] + a * at_points[w + 1])
                    for a in faces[k : k + 2]
                )
                patches.append(Patch(between(low, high, cells[1], order), first + k))
        return patches

    mesh = parametric_mesh(build, lengths | {"thickness": thickness}, order)
    return Section(mesh, plies, section_angles)
