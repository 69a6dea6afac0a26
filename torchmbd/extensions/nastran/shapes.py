"""Closed forms of the sections of PBARL and PBEAML by their measures.

Area and second moments are those of rectangles (y up, z to the right), about their common center. Torsion: the series of
Saint-Venant for each rectangle of an open section, Bredt's formula for a box. Shear carries the area of the webs along y
and of the flanges along z; 5/6 for a bar, 0.9 and 0.5 for a rod and a tube, as Nastran does.
Source: MSC Nastran Quick Reference Guide, PBARL and PBEAML (measures); S. Timoshenko, J. Goodier, Theory of Elasticity,
section 109 (series), 116 (Bredt); W. Young, R. Budynas, Roark's Formulas for Stress and Strain, table 9.2 (shear centers).
Checked in tests/extensions/nastran/test_shapes.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

RIGID_IN_SHEAR = 1e6  # in place of infinity: K1 or K2 zero, or blank on a PBAR


class SectionNumbers(NamedTuple):
    """A section about its center: area, second moments (I1 = int y2, I2 = int z2, I12 = int y z), torsion, shear factors.

    `center`: place y, z of the center, seen from the center of shear.
    """

    A: float
    I1: float
    I2: float
    I12: float
    J: float
    K1: float
    K2: float
    center: tuple[float, float] = (0.0, 0.0)


class Rectangle(NamedTuple):
    """A rectangle: middle y, z, height along y, width along z; `web`: shear along y runs through it, else that along z."""

    y: float
    z: float
    height: float
    width: float
    web: bool

    @property
    def area(self) -> float:
        return self.height * self.width


#: Rectangles, place y, z of the center of shear in their axes, J of a closed section (None: open).
Outline = tuple[list[Rectangle], tuple[float, float], float | None]


def of_shape(kind: str, d: Sequence[float]) -> SectionNumbers:
    """Return the section `kind` of the measures d. The text of a ValueError says which measures are allowed."""
    if not all(x > 0.0 for x in (d[:1] if kind == "TUBE" else d)):
        raise ValueError("measures > 0")
    if kind in ("ROD", "TUBE", "TUBE2"):
        return _round(kind, d)
    if kind == "HEXA":
        return _hexagon(*d)
    rectangles, shear, J = _OUTLINES[kind](*d)
    if any(not (r.height > 0.0 and r.width > 0.0) for r in rectangles):
        raise ValueError("thicknesses that leave room for webs and flanges")
    A = sum(r.area for r in rectangles)
    y, z = (sum(r.area * r[k] for r in rectangles) / A for k in (0, 1))
    I1 = sum(r.area * ((r.y - y) ** 2 + r.height**2 / 12.0) for r in rectangles)
    I2 = sum(r.area * ((r.z - z) ** 2 + r.width**2 / 12.0) for r in rectangles)
    I12 = sum(r.area * (r.y - y) * (r.z - z) for r in rectangles)
    J = sum(torsion(r.height, r.width) for r in rectangles) if J is None else J
    webs = sum(r.area for r in rectangles if r.web) / A
    shares = (5.0 / 6.0, 5.0 / 6.0) if kind == "BAR" else (webs, 1.0 - webs)
    return SectionNumbers(A, I1, I2, 0.0 if abs(I12) < 1e-12 * A * A else I12, J, *shares, (y - shear[0], z - shear[1]))


def torsion(height: float, width: float) -> float:
    """Torsion constant of a rectangle."""
    a, b = max(height, width) / 2.0, min(height, width) / 2.0
    series = sum(math.tanh(n * math.pi * a / (2 * b)) / n**5 for n in range(1, 40, 2))
    return a * b**3 * (16.0 / 3.0 - 1024.0 / math.pi**5 * b / a * series)


def _round(kind: str, d: Sequence[float]) -> SectionNumbers:
    outer, inner = d[0], {"ROD": 0.0, "TUBE": d[-1], "TUBE2": d[0] - d[-1]}[kind]
    if not 0.0 <= inner < outer:
        raise ValueError("an inner radius below the outer one")
    area, second = math.pi * (outer**2 - inner**2), math.pi / 4.0 * (outer**4 - inner**4)
    share = 0.9 if kind == "ROD" else 0.5
    return SectionNumbers(area, second, second, 0.0, 2.0 * second, share, share)


def _hexagon(corner: float, width: float, height: float) -> SectionNumbers:
    """A bar whose sides end in triangles of `corner`; J = A^4 / (40 (I1 + I2)) is Saint-Venant's estimate."""
    flat = width - 2.0 * corner
    if not flat > 0.0:
        raise ValueError("DIM2 > 2 DIM1")
    A = height * (flat + corner)
    I1 = flat * height**3 / 12.0 + corner * height**3 / 24.0
    arm = flat / 2.0 + corner / 3.0
    I2 = height * flat**3 / 12.0 + height * corner**3 / 18.0 + height * corner * arm**2
    return SectionNumbers(A, I1, I2, 0.0, A**4 / (40.0 * (I1 + I2)), 5.0 / 6.0, 5.0 / 6.0)


def _i(h: float, bottom: float, top: float, web: float, t_bottom: float, t_top: float) -> Outline:
    inner = h - t_bottom - t_top
    parts = [
        Rectangle(t_bottom / 2, 0.0, t_bottom, bottom, False),
        Rectangle(t_bottom + inner / 2, 0.0, inner, web, True),
        Rectangle(h - t_top / 2, 0.0, t_top, top, False),
    ]
    arm, low, high = h - (t_bottom + t_top) / 2, t_bottom * bottom**3, t_top * top**3
    return parts, (t_bottom / 2 + arm * high / (low + high), 0.0), None


def _i1(flanges: float, web: float, inner: float, h: float) -> Outline:
    t = (h - inner) / 2
    return _i(h, flanges + web, flanges + web, web, t, t)


def _t(width: float, h: float, flange: float, web: float) -> Outline:
    """The flange is on top."""
    parts = [
        Rectangle(-flange / 2, 0.0, flange, width, False),
        Rectangle(-(h + flange) / 2, 0.0, h - flange, web, True),
    ]
    return parts, (-flange / 2, 0.0), None


def _t2(width: float, h: float, flange: float, web: float) -> Outline:
    """The flange is at the bottom."""
    parts, shear, _ = _t(width, h, flange, web)
    return [r._replace(y=-r.y) for r in parts], (-shear[0], 0.0), None


def _t1(h: float, length: float, flange: float, web: float) -> Outline:
    """The flange stands to the right of a web that lies."""
    return (
        [Rectangle(0.0, 0.0, h, flange, True), Rectangle(0.0, -(flange + length) / 2, web, length, False)],
        (0.0, 0.0),
        None,
    )


def _chan(width: float, h: float, web: float, flange: float) -> Outline:
    """The web is at the left."""
    free = width - web
    sides = [Rectangle(s * (h - flange) / 2, web + free / 2, flange, free, False) for s in (-1, 1)]
    b, arm = width - web / 2, h - flange
    behind = 3.0 * b**2 * flange / (6.0 * b * flange + arm * web)
    return [Rectangle(0.0, web / 2, h, web, True), *sides], (0.0, web / 2 - behind), None


def _chan1(flange: float, web: float, inner: float, h: float) -> Outline:
    return _chan(flange + web, h, web, (h - inner) / 2)


def _chan2(leg: float, base: float, h: float, width: float) -> Outline:
    """Legs upwards, the base at the bottom."""
    parts, (_, z), _ = _chan(h, width, base, leg)
    return [Rectangle(r.z, r.y, r.width, r.height, not r.web) for r in parts], (z, 0.0), None


def _box(width: float, h: float, flange: float, web: float) -> Outline:
    return _box1(width, h, flange, flange, web, web)


def _box1(width: float, h: float, top: float, bottom: float, left_wall: float, right_wall: float) -> Outline:
    inner = h - top - bottom
    parts = [
        Rectangle((h - top) / 2, 0.0, top, width, False),
        Rectangle((bottom - h) / 2, 0.0, bottom, width, False),
        Rectangle((bottom - top) / 2, (left_wall - width) / 2, inner, left_wall, True),
        Rectangle((bottom - top) / 2, (width - right_wall) / 2, inner, right_wall, True),
    ]
    if not (inner > 0.0 and width > left_wall + right_wall):
        raise ValueError("walls that leave a cell free")
    a, b = width - (left_wall + right_wall) / 2, h - (top + bottom) / 2
    A = sum(r.area for r in parts)
    middle = (sum(r.area * r.y for r in parts) / A, sum(r.area * r.z for r in parts) / A)
    return parts, middle, 4.0 * (a * b) ** 2 / (a / top + a / bottom + b / left_wall + b / right_wall)


def _h(inner: float, flanges: float, h: float, web: float) -> Outline:
    """Two upright flanges, of half of `flanges` each, and a web that lies between them."""
    sides = [Rectangle(0.0, s * (inner + flanges / 2) / 2, h, flanges / 2, True) for s in (-1, 1)]
    return [*sides, Rectangle(0.0, 0.0, web, inner, False)], (0.0, 0.0), None


def _cross(arms: float, web: float, h: float, arm: float) -> Outline:
    sides = [Rectangle(0.0, s * (arms / 2 + web) / 2, arm, arms / 2, False) for s in (-1, 1)]
    return [Rectangle(0.0, 0.0, h, web, True), *sides], (0.0, 0.0), None


def _z(flange: float, web: float, inner: float, h: float) -> Outline:
    """The upper flange is at the left."""
    t = (h - inner) / 2
    sides = [Rectangle(s * (h - t) / 2, -s * (web + flange) / 2, t, flange, False) for s in (-1, 1)]
    return [Rectangle(0.0, 0.0, h, web, True), *sides], (0.0, 0.0), None


def _l(width: float, h: float, t_low: float, t_up: float) -> Outline:
    parts = [
        Rectangle(t_low / 2, width / 2, t_low, width, False),
        Rectangle((h + t_low) / 2, t_up / 2, h - t_low, t_up, True),
    ]
    return parts, (t_low / 2, t_up / 2), None


def _hat(h: float, t: float, top: float, brim: float) -> Outline:
    """Its center of shear is taken as its center: the section is for PBARL only."""
    side = h - 2 * t
    parts = [Rectangle(h - t / 2, 0.0, t, top, False)]
    parts += [Rectangle(h / 2, s * (top - t) / 2, side, t, True) for s in (-1, 1)]
    parts += [Rectangle(t / 2, s * (top + brim - t) / 2, t, brim + t, False) for s in (-1, 1)]
    y = sum(r.area * r.y for r in parts) / sum(r.area for r in parts)
    return parts, (y, 0.0), None


_OUTLINES: dict[str, Callable[..., Outline]] = {
    "BAR": lambda width, h: ([Rectangle(0.0, 0.0, h, width, True)], (0.0, 0.0), None),
    "BOX": _box,
    "BOX1": _box1,
    "CHAN": _chan,
    "CHAN1": _chan1,
    "CHAN2": _chan2,
    "CROSS": _cross,
    "H": _h,
    "HAT": _hat,
    "I": _i,
    "I1": _i1,
    "L": _l,
    "T": _t,
    "T1": _t1,
    "T2": _t2,
    "Z": _z,
}
#: Measures of each section.
SHAPES = {"ROD": 1, "TUBE": 2, "TUBE2": 2, "HEXA": 3, "BAR": 2, "BOX1": 6, "I": 6} | {
    name: 4 for name in _OUTLINES if name not in ("BAR", "BOX1", "I")
}
