"""Plates that become warmer against CalculiX 2.20: shells S8R, and bricks C3D20R, a layer of them for each ply.

The thermal gradient of a composite shell is scaled in CalculiX (docs/reference/other_programs.md), so stacks under a
gradient are compared with bricks, whose nodes have temperatures T + g z, and a shell of one ply with S8R.
Numbers were recorded of the tests that run CalculiX. Bricks count at inner nodes, 40 mm from the clamp and 10 mm from the free
edges: edge layers of bricks have no counterpart in a shell. The largest difference in v of [0, 90] is 2.5 % with them, 1.4 and
0.8 % with a half and a quarter of the thickness, 0.1 % without. The layer at the clamp also turns unbalanced stacks in their
plane, so v alone differs by up to 2.0 %. Both shells differ at the clamp of [0, 90] by 2.4, 1.4, 0.8 % of v with cells of 20,
10, 5 mm: a matter of the mesh.
"""

from __future__ import annotations

import itertools
import math
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import torchmbd as mbd

PLY = mbd.Ply(128e9, 10.1e9, 5.36e9, 4.9e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6)
LENGTH, WIDTH = 0.3, 0.1
CELLS = (60, 20)  # of both
NEEDS_CALCULIX = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")

# Plies [deg] and thicknesses [m] from the bottom; the surface of the nodes is the face of a ply, where bricks have nodes.
STACKS = {
    "[20, -50, 75]": ([20, -50, 75], [0.5e-3, 1.0e-3, 1.5e-3]),
    "[0, 90]": ([0, 90], [1e-3, 1e-3]),
    "[30, 60]": ([30, 60], [1e-3, 1e-3]),
}
CHANGES = {"uniform": (80.0, 0.0), "gradient": (0.0, 2e4)}  # T [K], g [K/m]
# Corners of a brick behind its first, in halves of its sides, in the order of C3D20R.
CORNERS = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)]
SIDES = [(1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0), (1, 0, 2), (2, 1, 2), (1, 2, 2), (0, 1, 2)]
POSTS = [(0, 0, 1), (2, 0, 1), (2, 2, 1), (0, 2, 1)]


def warmed(angles: list, thickness: list, T: float, g: float, cells: tuple[int, int] = CELLS) -> tuple:
    """A plate, clamped at its left edge and warmer, and the displacements of its nodes [n, 3]."""
    mesh = mbd.mesh.rectangle(LENGTH, WIDTH, cells, "quad")
    laminate = mbd.Laminate(PLY, mbd.deg(angles), thickness)
    body = mbd.FlexibleBody.plate("plate", mesh, laminate, 3, reference="left_edge", expansion=True)
    body.position.copy_(body.origin)
    hold = mbd.Fixed(mbd.Ground().at(*body.origin.tolist()), body.at("left_edge"))
    system = mbd.System([body], [hold], [mbd.Temperature(body, T, gradient=g)], truncation=None)
    w = mbd.equilibrium(system).body("plate").w[0, 0]
    return body, (body.structure()["psi"] @ w).detach()[:, :3]


def run(folder: Path, lines: list[str]) -> np.ndarray:
    """Displacements of all nodes by CalculiX [n, 3]."""
    (folder / "plate.inp").write_text("\n".join([*lines, "*NODE PRINT, NSET=NALL", "U", "*END STEP", ""]))
    subprocess.run(["ccx", "plate"], cwd=folder, check=True, capture_output=True)
    rows = re.findall(r"^\s+\d+\s+(\S+)\s+(\S+)\s+(\S+)\s*$", (folder / "plate.dat").read_text(), re.MULTILINE)
    return np.array(rows, dtype=float)


def shell(folder: Path, body: mbd.FlexibleBody, change: str) -> Tensor:
    """Displacements of the body's nodes by S8R on its mesh; `change`: the numbers of *TEMPERATURE behind the nodes."""
    head, _ = mbd.io.write_model(body, folder / "plate.inp").read_text().split("*STEP")
    none = ", ".join("0." for _ in change.split(","))
    step = ["*INITIAL CONDITIONS, TYPE=TEMPERATURE", f"NALL, {none}", "*STEP", "*STATIC", "*TEMPERATURE"]
    return torch.from_numpy(run(folder, [head.rstrip(), *step, f"NALL, {change}"])[: len(body.mesh.nodes)])


def bricks(folder: Path, angles: list, thickness: list, T: float, g: float) -> tuple[Tensor, Tensor]:
    """Places [n, 2] of the nodes of the shell's corners, and their displacements [n, 3], by a layer of C3D20R for each ply."""
    faces = np.cumsum([-sum(thickness) / 2.0, *thickness])
    z = np.sort(np.concatenate([faces, (faces[1:] + faces[:-1]) / 2.0]))
    x, y = (side * np.linspace(-0.5, 0.5, 2 * n + 1) for side, n in zip((LENGTH, WIDTH), CELLS, strict=True))
    grid = itertools.product(*(range(len(axis)) for axis in (x, y, z)))
    number = {at: k for k, at in enumerate((at for at in grid if sum(i % 2 for i in at) <= 1), start=1)}
    lines = ["*NODE, NSET=NALL"]
    lines += [f"{k}, {x[i]:.10g}, {y[j]:.10g}, {z[m]:.10g}" for (i, j, m), k in number.items()]
    count = itertools.count(1)
    for ply in range(len(angles)):
        lines.append(f"*ELEMENT, TYPE=C3D20R, ELSET=PLY_{ply}")
        for a, b in itertools.product(*map(range, CELLS)):
            nodes = [
                str(number[2 * a + i, 2 * b + j, 2 * ply + m]) for i, j, m in itertools.chain(CORNERS, SIDES, POSTS)
            ]
            lines += [f"{next(count)}, {', '.join(nodes[:10])},", ", ".join(nodes[10:])]
    lines += ["*MATERIAL, NAME=CARBON", "*ELASTIC, TYPE=ENGINEERING CONSTANTS"]
    lines += [f"{PLY.E1}, {PLY.E2}, {PLY.E2}, {PLY.nu12}, 0., 0., {PLY.G12}, {PLY.G13},", f"{PLY.G23}"]
    lines += ["*EXPANSION, TYPE=ORTHO", f"{PLY.alpha1}, {PLY.alpha2}, {PLY.alpha2}"]
    for ply, angle in enumerate(angles):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        lines.append(f"*ORIENTATION, NAME=AXES_{ply}, SYSTEM=RECTANGULAR")
        lines.append(f"{c:.12f}, {s:.12f}, 0., {-s:.12f}, {c:.12f}, 0.")
        lines.append(f"*SOLID SECTION, ELSET=PLY_{ply}, MATERIAL=CARBON, ORIENTATION=AXES_{ply}")
    lines += ["*NSET, NSET=CLAMP", *(f"{k}," for (i, _, _), k in number.items() if i == 0), "*BOUNDARY", "CLAMP, 1, 3"]
    lines += ["*INITIAL CONDITIONS, TYPE=TEMPERATURE", "NALL, 0.", "*STEP", "*STATIC", "*TEMPERATURE"]
    lines += [f"{k}, {T + g * z[m]:.10g}" for (_, _, m), k in number.items()]
    moved = run(folder, lines)
    middle = int(np.abs(z).argmin())
    rows = [(x[i], y[j], *moved[k - 1]) for (i, j, m), k in number.items() if m == middle and i % 2 == j % 2 == 0]
    table = torch.tensor(rows, dtype=torch.float64)
    return table[:, :2], table[:, 2:]


def inner(places: Tensor) -> Tensor:
    """Return True for each place [n, 2] that lies away from the clamp and the free edges [n]."""
    x, y = places[:, :2].unbind(1)
    return (x > 0.0399 - LENGTH / 2) & (x < LENGTH / 2 - 0.0099) & (y.abs() < WIDTH / 2 - 0.0099)


def sizes(u: Tensor) -> Tensor:
    """Largest displacements of u [n, 3] in the plane and across it [2]."""
    return torch.stack([u[:, :2].norm(dim=1).max(), u[:, 2].abs().max()])


# Largest displacements [m] in the plane and across it, at inner nodes of bricks.
BRICKS = {
    ("[20, -50, 75]", "uniform"): [3.436315e-4, 4.507348e-2],
    ("[20, -50, 75]", "gradient"): [5.865923e-5, 9.088672e-3],
    ("[0, 90]", "uniform"): [1.732932e-4, 4.282859e-2],
    ("[0, 90]", "gradient"): [2.472893e-5, 6.309496e-3],
    ("[30, 60]", "uniform"): [6.133618e-4, 2.700811e-2],
    ("[30, 60]", "gradient"): [1.758853e-5, 1.324568e-2],
}
SHELLS = {  # plies [deg], thicknesses [m], T [K], g [K/m]
    "[20, -50, 75]": ([20, -50, 75], [1e-3, 2e-3, 1.5e-3], 80.0, 0.0),
    "[0, 90]": (*STACKS["[0, 90]"], 80.0, 0.0),
    "[30, 60]": (*STACKS["[30, 60]"], 80.0, 0.0),
    "[40] under a gradient": ([40], [2e-3], 30.0, 2e4),
}
# Largest displacements [m] of all nodes of S8R, along x, y, z.
LARGEST = {
    "[20, -50, 75]": [2.565904e-4, 2.824519e-4, 2.767233e-2],
    "[0, 90]": [1.777575e-4, 2.973184e-5, 4.579865e-2],
    "[30, 60]": [3.352548e-4, 5.499258e-4, 2.885825e-2],
    "[40] under a gradient": [1.105939e-4, 2.354918e-4, 1.391793e-2],
}
cases = pytest.mark.parametrize(("stack", "change"), [*BRICKS])
plates = pytest.mark.parametrize("plate", [*SHELLS])


@pytest.mark.thorough
@cases
def test_stacks_move_as_recorded_of_bricks(stack, change):
    """The largest displacements in the plane and across it within one percent."""
    body, moved = warmed(*STACKS[stack], *CHANGES[change])
    assert sizes(moved[inner(body.mesh.nodes)]).tolist() == pytest.approx(BRICKS[stack, change], rel=1e-2)


@pytest.mark.thorough
@plates
def test_plates_move_as_recorded_of_shells(plate):
    """The three components of the largest displacement within one percent."""
    _, moved = warmed(*SHELLS[plate])
    assert moved.abs().amax(0).tolist() == pytest.approx(LARGEST[plate], rel=1e-2)


@pytest.mark.thorough
@NEEDS_CALCULIX
@cases
def test_bricks_of_calculix_move_as_the_stack(stack, change, tmp_path):
    """All displacements at inner nodes within one percent of the largest in the plane, and across it."""
    body, moved = warmed(*STACKS[stack], *CHANGES[change])
    places, theirs = bricks(tmp_path, *STACKS[stack], *CHANGES[change])
    away, near = inner(places), torch.cdist(places, body.mesh.nodes[:, :2]).argmin(1)
    largest, off = sizes(theirs[away]), sizes((moved[near] - theirs)[away])
    assert bool((off < 1e-2 * largest).all())
    assert largest.tolist() == pytest.approx(BRICKS[stack, change], rel=1e-4)


@pytest.mark.thorough
@NEEDS_CALCULIX
@plates
def test_shells_of_calculix_move_as_the_plate(plate, tmp_path):
    """All displacements within one percent of the largest in their direction."""
    _, _, T, g = SHELLS[plate]
    body, moved = warmed(*SHELLS[plate])
    theirs = shell(tmp_path, body, f"{T}, {g}" if g else f"{T}")
    largest = theirs.abs().amax(0)
    assert bool(((moved - theirs).abs().amax(0) < 1e-2 * largest).all())
    assert largest.tolist() == pytest.approx(LARGEST[plate], rel=1e-4)
