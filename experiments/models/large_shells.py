"""Shells of many freedoms: a hinged plate and a wing box with spars and ribs, each a system of one body, "shell".

    plate(nx, ny)               0.6 m x 0.2 m, nx x ny cells, hinged at its left edge             6 (nx + 1) (ny + 1) freedoms
    wing_box(nx, ny, nz, ribs)  3 m x 0.6 m x 0.15 m, two skins, three spars, ribs + 1 ribs, hinged at its root

Four plies of carbon, gravity. Measured by `python -m experiments.benchmark large`.
"""

from __future__ import annotations

import numpy as np
import torch

import torchmbd as mbd
from torchmbd.examples import carbon

PLIES = (45.0, -45.0, 0.0, 90.0)
LENGTH, WIDTH, HEIGHT = 3.0, 0.6, 0.15  # of the wing box


def plate(nx: int, ny: int, modes: int = 12) -> mbd.System:
    """The hinged plate."""
    laminate = mbd.Laminate(carbon(), angles=mbd.deg(PLIES), thickness=1e-3)
    mesh = mbd.mesh.rectangle(length=0.6, width=0.2, cells=(nx, ny))
    return _hinged(mbd.FlexibleBody.plate("shell", mesh, laminate, modes=modes, position=(0.3, 0, 0)), "left")


def wing_box(nx: int, ny: int, nz: int, ribs: int, modes: int = 10) -> mbd.System:
    """The hinged wing box: nx cells along it, ny across, nz in its height; nx is a multiple of `ribs`, ny of 2."""
    mesh, direction = box_mesh(nx, ny, nz, ribs)
    laminate = mbd.Laminate(carbon(), angles=mbd.deg(PLIES), thickness=2e-3)
    box = mbd.FlexibleBody.plate("shell", mesh, laminate, modes=modes, reference="root", direction=direction)
    return _hinged(box, "root")


def box_mesh(nx: int, ny: int, nz: int, ribs: int) -> tuple[mbd.Mesh, torch.Tensor]:
    """The mesh of a wing box and the x-axis of the laminate in each of its cells."""
    places: dict[tuple[int, int, int], int] = {}

    def at(i: int, j: int, k: int) -> int:
        return places.setdefault((i, j, k), len(places))

    skins = [
        [at(i, j, k), at(i + 1, j, k), at(i + 1, j + 1, k), at(i, j + 1, k)]
        for k in (0, nz)
        for i in range(nx)
        for j in range(ny)
    ]
    spars = [
        [at(i, j, k), at(i + 1, j, k), at(i + 1, j, k + 1), at(i, j, k + 1)]
        for j in (0, ny // 2, ny)
        for i in range(nx)
        for k in range(nz)
    ]
    rib_cells = [
        [at(i, j, k), at(i, j + 1, k), at(i, j + 1, k + 1), at(i, j, k + 1)]
        for i in range(0, nx + 1, nx // ribs)
        for j in range(ny)
        for k in range(nz)
    ]
    size = np.array([LENGTH / nx, WIDTH / ny, HEIGHT / nz])
    nodes = torch.tensor(np.array(list(places)) * size, dtype=torch.float64)
    root = [node for (i, _, _), node in places.items() if i == 0]
    along = len(skins) + len(spars)
    direction = torch.tensor([[1.0, 0.0, 0.0]] * along + [[0.0, 1.0, 0.0]] * len(rib_cells), dtype=torch.float64)
    quads = torch.tensor(skins + spars + rib_cells)
    return mbd.Mesh(nodes, quads=quads, node_sets={"root": root}, as_given=True), direction


def _hinged(shell: mbd.FlexibleBody, end: str) -> mbd.System:
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), shell.at(end), axis="y", name="hinge")
    return mbd.System([shell], [hinge], gravity=(0.0, 0.0, -9.81))
