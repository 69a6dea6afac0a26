"""Sections by dimension: rectangle and strip, box, tube and circle, I.

Plies are listed along the wall's normal n: strip, rectangle and flanges and web of an I from bottom (left) to top
(right), box and tube from inside to outside. The wall's tangent s = n cross x then runs clockwise around a box or a tube
(seen from the tip of x with y to the right and z up), and the ply angle is counted from x to s. So the upper wall of a box
is a plate in the x-y plane with normal z, and equal angles in all walls wind around it like a helix.
Elements of strip, box and I become short towards corners and edges, where warping bends most; those of a rectangle are equal.
All lengths in m, angles in rad; the origin of the section's axes is the center of the outer dimensions.
Rounding of corners is left out. Plies of a box meet on the diagonals of its corners.
Width, height, radius and thickness may be Parameters (mbd.variable): design variables of the section by these names.
Checked in tests/fem/sections/test_section_generators.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from torch import Tensor

from torchmbd.errors import InputError, keyword_hints, unknown
from torchmbd.fem.materials.ply import Lamina
from torchmbd.fem.sections.orthotropic import Orthotropic
from torchmbd.fem.sections.patches import Patch, between, graded, grid, line, parametric_mesh
from torchmbd.fem.sections.section import Section
from torchmbd.math.checked_numbers import is_whole, positive, reals
from torchmbd.math.gradients import constant_arguments
from torchmbd.math.plausible_units import DIMENSION, THICKNESS, warn_unusual
from torchmbd.math.variable import number

Angles = Sequence[float] | Tensor
WALLS = ("top", "right", "bottom", "left")


def angles_of_walls(angles: Angles | Mapping[str, Angles]) -> Mapping[str, Angles]:
    if not isinstance(angles, Mapping):
        return dict.fromkeys(WALLS, angles)
    check_names(angles, WALLS)
    return angles


def count_of_layers(angles: Any) -> int:
    """Return the number of plies; InputError if angles are not a list."""
    if isinstance(angles, str) or not hasattr(angles, "__len__") or getattr(angles, "ndim", 1) != 1:
        raise InputError("angles", angles, "one angle per ply, such as mbd.deg([45, -45]) [rad]")
    return len(angles)


def check_names(angles: Mapping[str, Angles], names: Sequence[str]) -> None:
    if not isinstance(angles, Mapping):
        raise InputError("angles", angles, f"a mapping with {', '.join(names)}")
    for name in angles:
        if name not in names:
            raise unknown("wall", name, names)
    counts = {name: count_of_layers(angles[name]) if name in angles else 0 for name in names}
    if len(set(counts.values())) > 1 or 0 in counts.values():
        raise InputError(
            "angles", angles, f"must have the same number of plies in {', '.join(names)}", state=f"have {counts} plies"
        )


def checked_thicknesses(thickness: float | Sequence[float] | Tensor, layers: int) -> np.ndarray:
    t = reals("thickness", thickness.detach() if isinstance(thickness, Tensor) else thickness).numpy()
    t = np.repeat(t, layers) if t.ndim == 0 else t
    if t.shape != (layers,) or layers == 0:
        noun = f"{t.size} thicknesses"
        raise InputError(
            "thickness", thickness, "one number, or one per ply [m]", noun=noun, state=f"for {layers} plies"
        )
    if not (np.isfinite(t) & (t > 0)).all():
        raise InputError("thickness", thickness, "finite numbers > 0 [m]")
    warn_unusual("thickness", float(t.max()), "m", THICKNESS)
    return t


def check_lengths(**lengths: float | Tensor) -> None:
    for name, value in lengths.items():
        warn_unusual(name, positive(name, number(value), "m"), "m", DIMENSION)


def check_cells(cells: Sequence[int], count: int, order: int) -> None:
    if not (isinstance(cells, Sequence) and len(cells) == count and all(is_whole(c) and c >= 1 for c in cells)):
        raise InputError("cells", cells, f"{count} integers >= 1")
    check_order(order)


def check_order(order: int) -> None:
    """InputError unless elements are linear (1) or quadratic (2)."""
    if order not in (1, 2):
        raise InputError("order", order, "1 (linear elements) or 2 (quadratic)")


Plies = Lamina | Orthotropic | Sequence[Lamina | Orthotropic]
Varying = float | Sequence[float] | Tensor  # numbers, or a Parameter (`constant_arguments`)


@constant_arguments
def strip(
    width: float | Tensor,
    ply: Plies,
    angles: Angles,
    thickness: Varying,
    cells: tuple[int, int] = (20, 1),
    order: int = 2,
) -> Section:
    """A laminate as a beam: width along y, plies stacked along z; cells across the width and through each ply.

    >>> section = mbd.sections.strip(0.04, mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3, cells=(8, 1))
    >>> round(section.mass()[0, 0].item(), 4)  # 1586 kg/m3 x 40 mm x 2 mm [kg/m]
    0.1269
    """
    check_lengths(width=width)
    check_cells(cells, 2, order)
    layers = count_of_layers(angles)
    checked_thicknesses(thickness, layers)

    def build(width: Any, thickness: Any) -> list[Patch]:
        y = graded(-width / 2, width / 2, cells[0], order)
        return _stack(y, np.broadcast_to(thickness, layers), cells[1], order)

    return Section(parametric_mesh(build, {"width": width, "thickness": thickness}, order), ply, angles)


@constant_arguments
def rectangle(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Angles = (0.0,),
    cells: tuple[int, int] = (8, 8),
    order: int = 2,
) -> Section:
    """Width along y, height along z, shared equally by the plies; cells over the whole width and height.

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> section = mbd.sections.rectangle(0.02, 0.01, steel)
    >>> round(section.stiffness()[4, 4].item() / (210e9 * 0.02 * 0.01**3 / 12), 3)  # E I about y
    1.0
    """
    check_lengths(width=width, height=height)
    check_cells(cells, 2, order)
    layers = count_of_layers(angles)
    each = max(1, round(cells[1] / layers))

    def build(width: Any, height: Any) -> list[Patch]:
        y = line(-width / 2, width / 2, cells[0], order)
        return _stack(y, np.full(layers, height / layers), each, order)

    return Section(parametric_mesh(build, {"width": width, "height": height}, order), ply, angles)


@constant_arguments
def box(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Angles | Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int, int] = (20, 12, 1),
    order: int = 2,
) -> Section:
    """Outer width along y and height along z.

    angles   of the plies from inside to outside, in all walls; or {"top": ..., "right": ..., "bottom": ..., "left": ...},
             which makes the section's angles those of top, right, bottom, left, one after the other
    thickness of every ply, or one for each ply of a wall
    cells    along the width, along the height, through each ply

    >>> carbon = mbd.examples.carbon()
    >>> section = mbd.sections.box(0.06, 0.02, carbon, {"top": mbd.deg([45]), "right": [0.0], "bottom": [0.0], "left": [0.0]},
    ...     thickness=1e-3, cells=(6, 3, 1))
    >>> section.angles.shape  # top, right, bottom, left
    torch.Size([4])
    """
    check_lengths(width=width, height=height)
    check_cells(cells, 3, order)
    walls = angles_of_walls(angles)
    layers = count_of_layers(walls["top"])
    total = checked_thicknesses(thickness, layers).sum()
    if not 2 * total < min(number(width), number(height)):
        sizes = f"{number(width):g} m x {number(height):g} m"
        state = f"has walls of {total:g} m in {sizes}"
        raise InputError(
            "thickness", thickness, "must have walls of less than half of both dimensions", noun="box", state=state
        )
    shared = not isinstance(angles, Mapping)

    def build(width: Any, height: Any, thickness: Any) -> list[Patch]:
        t = np.broadcast_to(thickness, layers)
        depth = t.sum() - np.concatenate([[0.0], np.cumsum(t)])
        patches = []
        for w, wall in enumerate(WALLS):
            count = cells[w % 2]
            for k in range(layers):
                along = graded(0.0, 1.0, count, order)
                inner, outer = (_edge(wall, width / 2 - d, height / 2 - d, along) for d in depth[k : k + 2])
                points = between(inner, outer, cells[2], order)
                patches.append(Patch(points, k if shared else w * layers + k))
        return patches

    plies = ply if shared or isinstance(ply, Lamina | Orthotropic) else list(ply) * (4 if len(ply) == layers else 1)
    section_angles = angles if shared else np.concatenate([np.asarray(walls[w]) for w in WALLS]).tolist()
    return Section(
        parametric_mesh(build, {"width": width, "height": height, "thickness": thickness}, order), plies, section_angles
    )


@keyword_hints
@constant_arguments
def tube(
    radius: float | Tensor,
    ply: Plies,
    angles: Angles,
    thickness: Varying,
    cells: tuple[int, int] = (48, 1),
    order: int = 2,
) -> Section:
    """A hollow circle of this outer radius; plies from inside to outside; cells around and through each ply.

    >>> wall = mbd.variable(0.5e-3)  # of each ply [m]: a design variable
    >>> section = mbd.sections.tube(0.02, mbd.examples.carbon(), mbd.deg([45, -45]), thickness=wall, cells=(16, 1))
    >>> sorted(name for name, _ in section.named_parameters())
    ['angles', 'thickness']
    """
    check_lengths(radius=radius)
    check_cells(cells, 2, order)
    layers = count_of_layers(angles)
    total = checked_thicknesses(thickness, layers).sum()
    if not total < number(radius):
        state = f"is {total:g} m of radius {number(radius):g} m"
        raise InputError("thickness", thickness, "less than the radius", noun="tube: thickness", state=state)
    around = line(math.pi / 2, -1.5 * math.pi, cells[0], order)  # clockwise from the top
    directions = np.stack([np.cos(around), np.sin(around)], axis=-1)

    def build(radius: Any, thickness: Any) -> list[Patch]:
        t = np.broadcast_to(thickness, layers)
        radii = radius - t.sum() + np.concatenate([[0.0], np.cumsum(t)])
        return [
            Patch(between(directions * low, directions * high, cells[1], order), layer)
            for layer, (low, high) in enumerate(pairwise(radii))
        ]

    return Section(parametric_mesh(build, {"radius": radius, "thickness": thickness}, order), ply, angles)


@constant_arguments
def circle(
    radius: float | Tensor,
    ply: Lamina | Orthotropic,
    angle: float = 0.0,
    cells: tuple[int, int] = (6, 4),
    order: int = 2,
) -> Section:
    """A solid circle of one material, its plies parallel to the x-y plane.

    cells   along each side of the square in its middle, and from there to the rim

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> section = mbd.sections.circle(0.01, steel)
    >>> round(section.stiffness()[0, 0].item() / (210e9 * np.pi * 0.01**2), 3)  # E A
    1.0
    """
    check_lengths(radius=radius)
    check_cells(cells, 2, order)

    def build(radius: Any) -> list[Patch]:
        half = 0.5 * radius
        square = line(-half, half, cells[0], order)
        patches = [Patch(grid(square, square), 0)]
        for w in range(4):
            inner = _edge(WALLS[w], half, half, line(0.0, 1.0, cells[0], order))
            rim = line(0.75 * math.pi, 0.25 * math.pi, cells[0], order) - w * math.pi / 2
            outer = radius * np.stack([np.cos(rim), np.sin(rim)], axis=-1)
            patches.append(Patch(between(inner, outer, cells[1], order), 0))
        return patches

    return Section(parametric_mesh(build, {"radius": radius}, order, plane_angle=0.0), ply, (angle,))


@constant_arguments
def i_section(
    width: float | Tensor,
    height: float | Tensor,
    ply: Plies,
    angles: Mapping[str, Angles],
    thickness: Varying,
    cells: tuple[int, int, int] = (8, 20, 1),
    order: int = 2,
) -> Section:
    """Flanges of this width along y, whole height along z.

    angles     {"top": ..., "web": ..., "bottom": ...}: plies of the flanges from bottom to top, of the web from left to
               right (its normal is y, its tangent -z); the section's angles are those of top, web, bottom, one after the
               other. All three have equal numbers of plies
    thickness  of every ply, or one for each ply of a wall
    cells      along each half of a flange, along the web, through each ply

    >>> angles = {"top": [0.0], "web": mbd.deg([45]), "bottom": [0.0]}
    >>> mbd.sections.i_section(0.04, 0.06, mbd.examples.carbon(), angles, thickness=2e-3, cells=(2, 6, 1)).angles.shape
    torch.Size([3])
    """
    check_lengths(width=width, height=height)
    check_cells(cells, 3, order)
    names = ("top", "web", "bottom")
    check_names(angles, names)
    layers = count_of_layers(angles["top"])
    total = checked_thicknesses(thickness, layers).sum()
    if not (2 * total < number(height) and total < number(width)):
        sizes = f"{number(width):g} m x {number(height):g} m"
        noun = f"i_section: walls of {total:g} m"
        raise InputError("thickness", thickness, "thinner", noun=noun, state=f"do not fit into {sizes}")

    def build(width: Any, height: Any, thickness: Any) -> list[Patch]:
        t = np.broadcast_to(thickness, layers)
        stack = np.concatenate([[0.0], np.cumsum(t)]) - t.sum() / 2  # across a wall
        across = [line(a, b, cells[2], order) for a, b in pairwise(stack)]  # of the web, and of the flanges above it
        free = [graded(-width / 2, stack[0], cells[0], order), graded(stack[-1], width / 2, cells[0], order)]
        patches = []
        for block, middle in ((0, (height - t.sum()) / 2), (2, (t.sum() - height) / 2)):
            for k in range(layers):
                z = line(middle + stack[k], middle + stack[k + 1], cells[2], order)
                patches += [Patch(grid(y, z), block * layers + k) for y in (*free, *across)]
        web = graded(height / 2 - t.sum(), t.sum() - height / 2, cells[1], order)
        for k in range(layers):
            patches.append(Patch(grid(across[k], web).transpose(1, 0, 2), layers + k))
        return patches

    plies = ply if isinstance(ply, Lamina | Orthotropic) else list(ply) * (3 if len(ply) == layers else 1)
    section_angles = np.concatenate([np.asarray(angles[n]) for n in names]).tolist()
    return Section(
        parametric_mesh(build, {"width": width, "height": height, "thickness": thickness}, order), plies, section_angles
    )


def _stack(y: np.ndarray, t: np.ndarray, each: int, order: int) -> list[Patch]:
    """Return a patch of each ply: nodes at y across, thicknesses t, `each` elements through the thickness."""
    faces = np.concatenate([[0.0], np.cumsum(t)]) - t.sum() / 2
    return [Patch(grid(y, line(a, b, each, order)), layer) for layer, (a, b) in enumerate(pairwise(faces))]


def _edge(wall: str, y: float, z: float, along: np.ndarray) -> np.ndarray:
    """Points at shares `along` of one side of a rectangle of these half dimensions, clockwise."""
    corners = {"top": ((-y, z), (y, z)), "right": ((y, z), (y, -z)), "bottom": ((y, -z), (-y, -z))}
    start, end = corners.get(wall, ((-y, -z), (-y, z)))
    return np.array(start) + along[:, None] * (np.array(end) - np.array(start))
