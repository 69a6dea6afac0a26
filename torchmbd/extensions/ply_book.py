"""A ply book: what the workshop lays up, as a table (CSV) or a page with sketches (HTML).

    body   zone   ply   angle [deg]   thickness [mm]   material   height of its bottom [mm]

Plies count from the bottom of each zone, 1 first; a symmetric stack has all of them. Materials are numbered by their constants,
which the page lists.
Checked in tests/extensions/test_ply_book.py.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import astuple, dataclass
from html import escape
from pathlib import Path
from typing import Any

from torchmbd.design.flexible_bodies import flexible_bodies
from torchmbd.errors import InputError, warn
from torchmbd.math.variable import number, without_variables

__all__ = ["write_ply_book"]

HEADINGS = ("body", "zone", "ply", "angle [deg]", "thickness [mm]", "material", "bottom [mm]")
_MOST_DIGITS = 10
_CONSTANTS = ("E1", "E2", "G12", "G13", "G23", "nu12", "density")
_UNITS = ("GPa", "GPa", "GPa", "GPa", "GPa", "", "kg/m3")
_WIDTH, _PLY = 220, 24  # of a sketch and of its plies [px]


@dataclass(frozen=True)
class Row:
    """One ply: names, its number from the bottom, numbers in degrees and mm."""

    body: str
    zone: str
    ply: int
    angle: float
    thickness: float
    material: str
    bottom: float


def write_ply_book(design: Any, path: str | Path) -> Path:
    """Write the plies of all laminated parts of a design, as a workshop lays them up.

    design   result of mbd.optimize or mbd.optimization.multistart, study of mbd.load, System or body
    path     the file to write: .csv, a row for each ply; or .html, with a table and a sketch for each part
    Returns the path. Raises InputError if fibers vary over a part. Warns of bodies without laminated shells, which it leaves
    out.

    >>> path = mbd.io.write_ply_book(mbd.examples.arm(), "arm.csv")
    >>> print(*path.read_text().splitlines()[:2], sep="\\n")
    body,zone,ply,angle [deg],thickness [mm],material,bottom [mm]
    arm,plate,1,45,1,M1,-1
    """
    path = Path(path)
    if path.suffix.lower() not in (".csv", ".html"):
        raise InputError("path", str(path), "a name that ends in .csv or .html")
    rows, materials = _rows(flexible_bodies("design", design))
    path.write_text(_csv(rows) if path.suffix.lower() == ".csv" else _page(rows, materials), encoding="utf-8")
    return path


def _rows(bodies: list[Any]) -> tuple[list[Row], dict[str, tuple]]:
    """All plies, and the constants of each material by its name."""
    rows: list[Row] = []
    names: dict[tuple, str] = {}
    for body in bodies:
        if not body.plates:
            warn(f"body {body.name!r} has no laminated shells: the ply book leaves it out")
        for zone, part in body.plates.items():
            laminate = part.laminates[0]
            if laminate.field is not None or laminate.angles.dim() > 1:
                raise InputError(
                    (body.name, zone),
                    hint="mbd.viz.save_mesh, which draws the fibers",
                    noun=f"plies of {body.name}.{zone}",
                    allowed="one stack",
                    state="vary over the part or between designs",
                )
            bottoms = laminate.faces.detach()[:, 0].tolist()
            angles, thickness = (x.detach().tolist() for x in (laminate.layer_angles, laminate.layer_thickness))
            for k, layer in enumerate(laminate.layer_plies):
                material = names.setdefault(astuple(without_variables(layer)), f"M{len(names) + 1}")
                numbers = math.degrees(angles[k]), 1e3 * thickness[k], 1e3 * bottoms[k]
                rows.append(Row(body.name, zone, k + 1, *numbers[:2], material, numbers[2]))
    constants = {
        names[astuple(without_variables(layer))]: tuple(float(number(getattr(layer, name))) for name in _CONSTANTS)
        for body in bodies
        for part in body.plates.values()
        for layer in part.laminates[0].layer_plies
    }
    return rows, constants


def _texts(row: Row) -> list[str]:
    return [x if isinstance(x, str) else f"{round(x, 9) + 0.0:.{_MOST_DIGITS}g}" for x in astuple(row)]


def _csv(rows: list[Row]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(HEADINGS)
    table.writerows(map(_texts, rows))
    return text.getvalue()


def _page(rows: list[Row], materials: dict[str, tuple]) -> str:
    """The page: a table of the materials, then a sketch and a table for each zone."""
    heads = [f"{name} [{unit}]" if unit else name for name, unit in zip(_CONSTANTS, _UNITS, strict=True)]
    lines = [
        [name, *(f"{x / 1e9 if unit == 'GPa' else x:.6g}" for x, unit in zip(numbers, _UNITS, strict=True))]
        for name, numbers in materials.items()
    ]
    parts = ["<!DOCTYPE html><html><head><meta charset='utf-8'><title>Ply book</title><style>"]
    parts += ["body{font-family:sans-serif}table{border-collapse:collapse;margin:1em 0}"]
    parts += ["td,th{border:1px solid #999;padding:2px 8px;text-align:right}</style></head><body><h1>Ply book</h1>"]
    parts += [_table(["material", *heads], lines)]
    for key in dict.fromkeys((row.body, row.zone) for row in rows):
        plies = [row for row in rows if (row.body, row.zone) == key]
        parts += [f"<h2>{escape(' / '.join(key))}</h2>", _sketch(plies)]
        parts += [_table(HEADINGS[2:], [_texts(row)[2:] for row in reversed(plies)])]
    return "\n".join(
        [*parts, "<p>Ply 1 lies at the bottom; angles count about the normal from the x-axis.</p></body></html>\n"]
    )


def _table(heads: Any, rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in row)}</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _sketch(plies: list[Row]) -> str:
    """The stack as it lies, the top ply above, hatched along its fibers."""
    height = _PLY * len(plies)
    lines = []
    for k, ply in enumerate(reversed(plies)):
        x, y = math.cos(math.radians(ply.angle)), math.sin(math.radians(ply.angle))
        middle = _PLY * (k + 0.5)
        reach = min(0.45 * _PLY / max(abs(y), 1e-9), 0.6 * _PLY)
        lines.append(f"<rect x='0' y='{_PLY * k}' width='{_WIDTH}' height='{_PLY}' fill='#eef' stroke='#447'/>")
        lines += [
            f"<line x1='{at - reach * x:.1f}' y1='{middle + reach * y:.1f}' x2='{at + reach * x:.1f}' "
            f"y2='{middle - reach * y:.1f}' stroke='#447'/>"
            for at in range(_PLY, _WIDTH - _PLY // 2, _PLY)
        ]
        lines.append(f"<text x='{_WIDTH + 6}' y='{middle + 5}' font-size='13'>{ply.ply}: {_texts(ply)[3]} deg</text>")
    return f"<svg width='{_WIDTH + 140}' height='{height}' role='img'>{''.join(lines)}</svg>"
