"""A shell model as an input file (.inp) of CalculiX and Abaqus: shells with composite sections, and modes (*FREQUENCY).

    quadratic   S8R, S6: CalculiX has composite sections for these alone; nodes in the middles of sides are added
    linear      S4, S3: of Abaqus

Each set of cells whose laminates lie alike has a section, each ply angle in it an orientation: its axes 1 and 2. The numbers
E3, nu13, nu23 and alpha3 that these files ask for do not enter plane stress: E3 is E2, alpha3 is alpha2, the ratios are zero.
Both programs read twenty columns of a number: CalculiX would take 6.123233995736766e-17, the cosine of 90 degrees, for 0.61.
Source: CalculiX CrunchiX User's Manual 2.20; Abaqus Keywords Reference Guide.
Checked in tests/extensions/shell_models/test_write_model.py, where CalculiX is installed against its frequencies.
"""

from __future__ import annotations

import itertools
import math
import re

import numpy as np

from torchmbd.extensions.nastran.materials import Units
from torchmbd.extensions.shell_models.shell_model import ShellModel, Stack
from torchmbd.fem.materials import Ply

_TYPES = {"quadratic": {3: "S6", 4: "S8R"}, "linear": {3: "S3", 4: "S4"}}
ELEMENTS = tuple(_TYPES)
_ALIKE = 9  # digits of an axis
_COLUMNS = 20  # of a number


def input_file(model: ShellModel, units: Units, modes: int, elements: str) -> list[str]:
    """Return the lines of the file; numbers of nodes and cells count from 1."""
    nodes, cells, reference = model.nodes, model.cells, model.reference
    if elements == "quadratic":
        nodes, cells, reference = _with_middles(model)
    lines = ["*HEADING", f"{model.name}: {len(nodes)} nodes, {len(cells)} shells", "*NODE, NSET=NALL"]
    lines += [
        f"{k}, {', '.join(map(_number, place))}" for k, place in enumerate((nodes / units.length).tolist(), start=1)
    ]
    zones = _zones(model)
    for number, (stack, members) in enumerate(zones, start=1):
        for corners in (3, 4):
            kind = [k for k in members if len(model.cells[k]) == corners]
            if kind:
                lines.append(f"*ELEMENT, TYPE={_TYPES[elements][corners]}, ELSET={_set(model, stack, number)}")
                lines += [f"{k + 1}, {', '.join(str(c + 1) for c in cells[k])}" for k in kind]
    for k, ply in enumerate(model.materials, start=1):
        lines += _material(k, ply, units)
    for number, (stack, members) in enumerate(zones, start=1):
        lines += _section(model.stacks[stack], number, _set(model, stack, number), model.axes[members[0]], units)
    lines += ["*NSET, NSET=REFERENCE", *(f"{node + 1}," for node in reference)]
    lines += ["*BOUNDARY", "REFERENCE, 1, 6", "*STEP", "*FREQUENCY", str(modes), "*NODE FILE", "U", "*END STEP"]
    return lines


def _with_middles(model: ShellModel) -> tuple[np.ndarray, list[list[int]], list[int]]:
    """Nodes with those in the middles of sides, cells with them behind their corners, and reference nodes with those between
    two of them."""
    middles: dict[tuple[int, int], int] = {}
    cells = []
    for corners in model.cells:
        sides = [tuple(sorted(side)) for side in itertools.pairwise([*corners, corners[0]])]
        cells.append([*corners, *(middles.setdefault((a, b), len(model.nodes) + len(middles)) for a, b in sides)])
    pairs = np.array(list(middles)).reshape(-1, 2)
    held = set(model.reference)
    between = [node for pair, node in middles.items() if held.issuperset(pair)]
    return np.vstack([model.nodes, model.nodes[pairs].mean(1)]), cells, [*model.reference, *between]


def _zones(model: ShellModel) -> list[tuple[int, list[int]]]:
    """Cells of one stack whose axes agree: (index of the stack, cells)."""
    zones: dict[tuple, list[int]] = {}
    for k, axes in enumerate(model.axes):
        key = int(model.stack[k]), *(np.round(axes[:2], _ALIKE) + 0.0).ravel().tolist()
        zones.setdefault(key, []).append(k)
    return [(key[0], members) for key, members in zones.items()]


def _set(model: ShellModel, stack: int, number: int) -> str:
    return f"{re.sub('[^A-Z0-9_]', '_', model.stacks[stack].name.upper())}_{number}"


def _number(x: float) -> str:
    """Text of a number: all of its digits where they fit into the columns, else thirteen."""
    text = repr(x)
    return text if len(text) <= _COLUMNS else f"{x:.12E}"


def _material(number: int, ply: Ply, units: Units) -> list[str]:
    E1, E2, G12, G13, G23 = (float(x) / units.stress for x in (ply.E1, ply.E2, ply.G12, ply.G13, ply.G23))
    moduli = ", ".join(map(_number, (E1, E2, E2, float(ply.nu12), 0.0, 0.0, G12, G13)))
    lines = [f"*MATERIAL, NAME=PLY_{number}", "*ELASTIC, TYPE=ENGINEERING CONSTANTS", f"{moduli},", _number(G23)]
    lines += ["*DENSITY", _number(float(ply.density) / units.density)]
    if ply.alpha1 is None or ply.alpha2 is None:
        return lines
    alpha1, alpha2 = float(ply.alpha1), float(ply.alpha2)
    return [*lines, "*EXPANSION, TYPE=ORTHO", ", ".join(map(_number, (alpha1, alpha2, alpha2)))]


def _section(stack: Stack, number: int, elset: str, axes: np.ndarray, units: Units) -> list[str]:
    """Orientations of the layers and the section. OFFSET is the height of the nodes above the middle over the thickness."""
    lines, names = [], {}
    for angle in stack.angles:
        if angle not in names:
            names[angle] = f"PLY_AXES_{number}_{len(names) + 1}"
            along = math.cos(angle) * axes[0] + math.sin(angle) * axes[1]
            across = math.cos(angle) * axes[1] - math.sin(angle) * axes[0]
            lines.append(f"*ORIENTATION, NAME={names[angle]}, SYSTEM=RECTANGULAR")
            lines.append(", ".join(map(_number, [*along.tolist(), *across.tolist()])))
    total = sum(stack.thickness)
    offset = -(stack.bottom + total / 2.0) / total
    option = f", OFFSET={_number(offset)}" if abs(offset) > 1e-12 else ""
    lines.append(f"*SHELL SECTION, COMPOSITE, ELSET={elset}{option}")
    for t, material, angle in zip(stack.thickness, stack.materials, stack.angles, strict=True):
        lines.append(f"{_number(t / units.length)}, , PLY_{material + 1}, {names[angle]}")
    return lines
