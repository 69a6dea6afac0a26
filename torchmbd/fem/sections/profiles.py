"""Open thin-walled profiles by dimension: C, L, Z, hat and T, with a laminate for each wall.

Walls of C, L, Z and hat follow one another with right angles; their plies meet on the diagonals of the corners. The middle of
the walls is a path of points P with directions d and normals n to their left:

    face at a distance a from the middle:   P + a (n1 + n2) at corners, P + a n at the ends

Plies are listed along n: from inside to outside of C, L and hat, from the right to the left of a Z's web, from bottom to top of
a T's flange. The wall's tangent s = d, and the ply angle is counted from x to s.
Corners of an inner radius r are arcs about C, from the end of one wall to the start of the next. s is 1 where the path turns
left and -1 where it turns right, R = r + t / 2 the radius of the middle of walls of thickness t:

    C = P - R d1 + s R n1,   points C + (R - s a) (d1 sin phi - s n1 cos phi),   0 <= phi <= 90 degrees

Each half of an arc has the laminate of its wall.
All lengths in m, angles in rad; the origin is the center of the outer dimensions.
Widths, heights, radii and thicknesses may be Parameters (mbd.variable): design variables of the section by these names.
Checked in tests/fem/sections/test_profiles.py: against closed forms of thin walls.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
from torchmbd.math.checked_numbers import nonnegative, positive
from torchmbd.math.gradients import constant_arguments, is_variable
from torchmbd.math.variable import number

_RIGHT, _LEFT, _UP, _DOWN = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)
# Along each wall and through each ply: torsion within 1 % of its limit.
_CELLS = (12, 1)
_ARC = 2  # elements along half of a corner


@constant_arguments
def c_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
    radius: float | Tensor = 0.0,
) -> Section:
    """A channel that opens to +y: outer width of its flanges, outer height of its web.

    angles     of the plies from inside to outside, in all walls; or {"bottom": ..., "web": ..., "top": ...}, which makes the
               section's angles those of bottom, web, top, one after the other. All walls have equal numbers of plies
    thickness  of every ply, or one for each ply of a wall
    cells      along each wall, through each ply
    radius     of the inside of the corners, which are sharp by default; elements of order 1 approximate it by 4 straight sides

    >>> section = mbd.sections.c_section(0.03, 0.06, mbd.examples.carbon(), mbd.deg([0, 45]), thickness=1e-3, cells=(4, 1))
    >>> round(section.mass()[0, 0].item() / 1586.0 * 1e6, 6)  # area: 2 mm x (60 + 2 x 28) mm
    232.0
    """

    def path(t: Any, width: Any, height: Any) -> list[tuple]:
        y, z = (t - width) / 2, (height - t) / 2
        return [(width / 2, -z), (y, -z), (y, z), (width / 2, z)]

    walls = {"bottom": _LEFT, "web": _UP, "top": _RIGHT}
    lengths = {"width": width, "height": height}
    return _chain("c_section", walls, path, lengths, (1, 2), ply, angles, thickness, cells, order, radius)


@constant_arguments
def l_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
    radius: float | Tensor = 0.0,
) -> Section:
    """An angle with its corner at the lower left: outer width and height; walls "bottom" and "left".

    Others as in `c_section`.
    """

    def path(t: Any, width: Any, height: Any) -> list[tuple]:
        y, z = (t - width) / 2, (t - height) / 2
        return [(width / 2, z), (y, z), (y, height / 2)]

    walls = {"bottom": _LEFT, "left": _UP}
    lengths = {"width": width, "height": height}
    return _chain("l_section", walls, path, lengths, (1, 1), ply, angles, thickness, cells, order, radius)


@constant_arguments
def z_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
    radius: float | Tensor = 0.0,
) -> Section:
    """A Z: outer width of each flange with the web, outer height; walls "bottom" (to +y), "web", "top" (to -y).

    Others as in `c_section`.
    """

    def path(t: Any, width: Any, height: Any) -> list[tuple]:
        y, z = width - t / 2, (height - t) / 2
        return [(y, -z), (0.0 * y, -z), (0.0 * y, z), (-y, z)]

    walls = {"bottom": _LEFT, "web": _UP, "top": _LEFT}
    lengths = {"width": width, "height": height}
    return _chain("z_section", walls, path, lengths, (1, 2), ply, angles, thickness, cells, order, radius)


@constant_arguments
def hat_section(
    width: float | Tensor,
    crown: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
    radius: float | Tensor = 0.0,
) -> Section:
    """A hat that opens to -z: width from foot to foot, outer width of its crown, outer height.

    Walls "left_foot", "left_web", "crown", "right_web", "right_foot". Others as in `c_section`.
    """
    if not number(crown) < number(width) - 2.0 * (r := _checked(radius)):
        limit = f"the width {number(width):g} m" + (f" minus twice the radius {r:g} m" if r else "")
        raise InputError(
            "crown", number(crown), f"less than {limit}", noun="hat_section: crown", shown=f"{number(crown):g} m"
        )

    def path(t: Any, width: Any, crown: Any, height: Any) -> list[tuple]:
        y, z = (crown - t) / 2, (height - t) / 2
        return [(-width / 2, -z), (-y, -z), (-y, z), (y, z), (y, -z), (width / 2, -z)]

    walls = {"left_foot": _RIGHT, "left_web": _UP, "crown": _RIGHT, "right_web": _DOWN, "right_foot": _RIGHT}
    lengths = {"width": width, "crown": crown, "height": height}
    return _chain("hat_section", walls, path, lengths, (2, 2, 2), ply, angles, thickness, cells, order, radius)


@constant_arguments
def t_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int] = _CELLS,
    order: int = 2,
) -> Section:
    """A T: width of its flange "top", whole height; the plies of its "web" from left to right. Others as in `c_section`.

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


def _checked(radius: float | Tensor) -> float:
    """The radius of corners as a number [m]; 0 for a sharp one, which cannot be a design variable."""
    check = positive if is_variable(radius) else nonnegative
    return check("radius", number(radius), "m")


def _laminates(
    kind: str,
    names: Sequence[str],
    lengths: Mapping[str, Any],
    least: Sequence[int],
    ply: Plies,
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int],
    order: int,
    radius: float = 0.0,
) -> tuple[int, list[int], Any, Any]:
    """Plies of a wall, the first layer of each wall, plies and angles of the section; InputError names what does not fit.

    least   walls, and radii of corners, that each length has to be larger than
    """
    check_lengths(**lengths)
    check_cells(cells, 2, order)
    if isinstance(angles, Mapping):
        check_names(angles, names)
    layers = count_of_layers(angles[names[0]] if isinstance(angles, Mapping) else angles)
    total = checked_thicknesses(thickness, layers).sum()
    for (name, length), walls in zip(lengths.items(), least, strict=True):
        if not walls * (total + radius) < number(length):
            sizes = f"the thickness {total:g} m of a wall" + (f" plus the radius {radius:g} m" if radius else "")
            limit = sizes if walls == 1 else f"{walls} times {f'({sizes})' if radius else sizes}"
            raise InputError(
                (str(kind), name),
                number(length),
                f"more than {limit}",
                hint="thinner or fewer plies" + (", a smaller radius" if radius else ""),
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
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int],
    order: int,
    radius: float | Tensor,
) -> Section:
    """A section whose walls follow one another.

    walls   name -> direction;  path: their points in the middle, of the thickness of a wall and the lengths
    """
    r = _checked(radius)
    layers, of_walls, plies, section_angles = _laminates(
        kind, list(walls), lengths, least, ply, angles, thickness, cells, order, r
    )
    directions = [np.array(d) for d in walls.values()]
    normals = [np.array((-z, y)) for y, z in walls.values()]

    def build(thickness: Any, radius: Any, **lengths: Any) -> list[Patch]:
        t = np.broadcast_to(thickness, layers)
        faces = np.concatenate([[0.0], np.cumsum(t)]) - t.sum() / 2
        points = [np.array(point) for point in path(t.sum(), **lengths)]
        bend = radius + t.sum() / 2 if r else 0.0  # the radius of the middle
        share, last = graded(0.0, 1.0, cells[0], order)[:, None], len(directions) - 1

        def wall(w: int, a: Any) -> Any:
            """Points of a wall at a distance a from its middle."""
            d, n = directions[w], normals[w]
            start, end = points[w] + (w > 0) * bend * d + a * n, points[w + 1] - (w < last) * bend * d + a * n
            if not r:  # to the diagonals
                start, end = start + (a * normals[w - 1] if w else 0.0), end + (a * normals[w + 1] if w < last else 0.0)
            return (1.0 - share) * start + share * end

        def arc(w: int, half: int, a: Any) -> Any:
            """Points of a half of the arc between a wall and the next one."""
            d, n = directions[w], normals[w]
            s = float(n @ directions[w + 1])
            center = points[w + 1] - bend * d + s * bend * n
            phi = 0.25 * np.pi * line(half, half + 1.0, _ARC, order)[:, None]
            return center + (bend - s * a) * (np.sin(phi) * d - s * np.cos(phi) * n)

        pieces = [(of_walls[w], partial(wall, w)) for w in range(last + 1)]
        if r:
            pieces += [(of_walls[w + half], partial(arc, w, half)) for w in range(last) for half in (0, 1)]
        return [
            Patch(between(at(faces[k]), at(faces[k + 1]), cells[1], order), first + k)
            for first, at in pieces
            for k in range(layers)
        ]

    mesh = parametric_mesh(build, lengths | {"thickness": thickness, "radius": radius}, order)
    return Section(mesh, plies, section_angles)
