"""A shell model as a Nastran file: GRID, CTRIA3 and CQUAD4 with THETA, PCOMP, MAT8, SPC1, and modes (SOL 103).

THETA is the angle from the first side of a cell to the x-axis of the laminate. Loss factors are not part of these cards.
Numbers stand in large fields, so that the file read again is the same body.
Source: MSC Nastran Quick Reference Guide.
Checked in tests/extensions/shell_models/test_write_model.py.
"""

from __future__ import annotations

import math

import numpy as np

from torchmbd.extensions.nastran.field_text import card_lines
from torchmbd.extensions.nastran.materials import Units
from torchmbd.extensions.shell_models.shell_model import ShellModel, Stack
from torchmbd.fem.materials import Ply


def bulk_data(model: ShellModel, units: Units, modes: int) -> list[str]:
    """Return the lines of the file; numbers of grids, cells and cards count from 1."""
    lines = [f"$ {model.name}: {len(model.nodes)} grids, {len(model.cells)} shells", "SOL 103", "CEND", "METHOD = 1"]
    lines += ["SPC = 1", "DISPLACEMENT(PLOT) = ALL", "BEGIN BULK", *card_lines("EIGRL", [1, "", "", modes])]
    for k, ply in enumerate(model.materials, start=1):
        lines += card_lines("MAT8", _material(k, ply, units))
    for k, stack in enumerate(model.stacks, start=1):
        lines += [f"$ {stack.name}", *card_lines("PCOMP", _property(k, stack, units))]
    for k, place in enumerate((model.nodes / units.length).tolist(), start=1):
        lines += card_lines("GRID", [k, "", *place])
    for k, corners in enumerate(model.cells):
        name = "CTRIA3" if len(corners) == 3 else "CQUAD4"
        theta = _theta(model.nodes[corners], model.axes[k])
        lines += card_lines(name, [k + 1, int(model.stack[k]) + 1, *(c + 1 for c in corners), theta])
    for node in model.reference:
        lines += card_lines("SPC1", [1, 123456, node + 1])
    return [*lines, "ENDDATA"]


def _material(number: int, ply: Ply, units: Units) -> list[str | int | float]:
    moduli = [float(x) / units.stress for x in (ply.E1, ply.E2)]
    shear = [float(x) / units.stress for x in (ply.G12, ply.G13, ply.G23)]
    fields = [number, *moduli, float(ply.nu12), *shear, float(ply.density) / units.density]
    expansion = ["" if x is None else float(x) for x in (ply.alpha1, ply.alpha2)]
    if ply.strength is None:
        return [*fields, *expansion]
    s = ply.strength
    limits = [float(x) for x in (s.Xt, s.Xc, s.Yt, s.Yc, s.S12)]
    mixed = float(s.interaction) / math.sqrt(math.prod(limits[:4])) * units.stress**2
    return [*fields, *expansion, "", *(x / units.stress for x in limits), "", mixed]


def _property(number: int, stack: Stack, units: Units) -> list[str | int | float]:
    fields: list[str | int | float] = [number, stack.bottom / units.length, *[""] * 6]
    for material, t, angle in zip(stack.materials, stack.thickness, stack.angles, strict=True):
        fields += [material + 1, t / units.length, math.degrees(angle), "YES"]
    return fields


def _theta(corners: np.ndarray, axes: np.ndarray) -> float:
    """Degrees from the first side, projected to the plane of the cell, to the x-axis."""
    side = corners[1] - corners[0]
    normal = np.cross(corners[2] - corners[0], corners[-1] - corners[1])
    normal = normal / np.linalg.norm(normal)
    side = side - (side @ normal) * normal
    return math.degrees(math.atan2(float(axes[0] @ np.cross(normal, side)), float(axes[0] @ side)))
