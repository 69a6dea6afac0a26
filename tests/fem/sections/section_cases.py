"""Sections of the literature, meshed as their authors did, and how matrices of other codes are read."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

import torchmbd as mbd
from torchmbd.fem import sections
from torchmbd.fem.sections import Orthotropic, Section, SectionMesh
from torchmbd.fem.sections.patches import Patch, between, grid, line, patch_mesh

#: BECAS lists (V_x, V_y, N, M_x, M_y, T) with x, y in the section and z along the beam; ANBA4 likewise.
FROM_BECAS = [2, 0, 1, 5, 3, 4]

ISOTROPIC = Orthotropic(100.0, 100.0, 100.0, 41.667, 41.667, 41.667, 0.2, 0.2, 0.2, 1.0)
SOFTER = Orthotropic(10.0, 10.0, 10.0, 4.1667, 4.1667, 4.1667, 0.2, 0.2, 0.2, 1.0)
ORTHOTROPIC = Orthotropic(480.0, 120.0, 120.0, 60.0, 50.0, 60.0, 0.19, 0.26, 0.19, 1.0)
#: AS4/3501-6 as in Yu et al. (2012), psi.
AS4 = Orthotropic(20.59e6, 1.42e6, 1.42e6, 0.87e6, 0.87e6, 0.696e6, 0.3, 0.3, 0.34, 1.0)
#: of the pipe of Yu, Volovoi, Hodges and Hong (2002), psi.
PIPE = Orthotropic(20.59e6, 1.42e6, 1.42e6, 0.87e6, 0.87e6, 0.87e6, 0.42, 0.42, 0.42, 1.0)
#: of the laminates in ANBA4's tests: g_yz, nu_yz across the fibre are its g_xy, nu_xy.
ANBA = Orthotropic(1.42e11, 9.8e9, 9.8e9, 6.0e9, 6.0e9, 4.8e9, 0.3, 0.3, 0.34, 1.0)


def two_materials(order: int = 1) -> Section:
    """BECAS S2: a square of 0.1 m, its half at negative y ten times as stiff as the other."""
    z = line(-0.05, 0.05, 10, order)
    halves = [Patch(grid(line(a, a + 0.05, 5, order), z), k) for k, a in enumerate((-0.05, 0.0))]
    return Section(patch_mesh(halves, order)[0], (ISOTROPIC, SOFTER), (0.0, 0.0))


def half_ring(cells: tuple[int, int] = (40, 2), order: int = 2) -> Section:
    """BECAS C2: radius 0.1 m, thickness 0.01 m, the half at negative y."""
    around = line(1.5 * math.pi, 0.5 * math.pi, cells[0], order)
    points = np.stack([np.cos(around), np.sin(around)], axis=-1)
    return Section(patch_mesh([Patch(between(0.09 * points, 0.1 * points, cells[1], order), 0)], order)[0], ISOTROPIC)


def racetrack(cells: tuple[int, int, int] = (20, 12, 4), order: int = 2) -> Section:
    """The multi-layer pipe: flat walls of 2 in with plies 90/0, round ends of 0.3 and 0.5 in with 45/-45, inside first."""
    flat, bend, through = cells
    radii = (0.3, 0.4, 0.5)
    patches = []
    for k in range(2):
        inner, outer = radii[k], radii[k + 1]
        up = grid(line(-1.0, 1.0, flat, order), line(inner, outer, through, order))
        patches.append(Patch(up, k))
        patches.append(Patch(-up, k))
        for side in (1.0, -1.0):
            around = line(0.5 * math.pi, -0.5 * math.pi, bend, order)
            points = side * np.stack([np.cos(around), np.sin(around)], axis=-1)
            ring = between(inner * points, outer * points, through, order) + np.array([side, 0.0])
            patches.append(Patch(ring, 2 + k))
    return Section(patch_mesh(patches, order)[0], PIPE, mbd.deg([90.0, 0.0, 45.0, -45.0]))


def sixteen_plies(turn: float = 0.0, soft_bottom: bool = False) -> Section:
    """ANBA4's coupon: 16 plies on crossed linear triangles, turned by `turn` degrees about the beam's axis."""
    width, height, nx, ny = 3.0023e-2, 1.9215e-3, 30, 32
    y, z = np.linspace(-width / 2, width / 2, nx + 1), np.linspace(-height / 2, height / 2, ny + 1)
    corners = np.stack(np.meshgrid(y, z, indexing="ij"), axis=-1).reshape(-1, 2)
    middles = np.stack(np.meshgrid((y[1:] + y[:-1]) / 2, (z[1:] + z[:-1]) / 2, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    a, b, c, d = (u * (ny + 1) + v for u, v in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    e = len(corners) + i * ny + j
    triangles = np.concatenate([np.stack([p, q, e], axis=1) for p, q in ((a, b), (b, c), (c, d), (d, a))])
    angle = math.radians(turn)
    rotation = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    mesh = SectionMesh(np.concatenate([corners, middles]) @ rotation, triangles, np.tile(j // 2, 4), angle)
    half = [20.0, -70.0, -70.0, 20.0] * 2
    plies: list[Orthotropic] = [ANBA] * 16
    if soft_bottom:
        plies[0] = Orthotropic.isotropic(98e6, 0.3, 1.0)
    return Section(mesh, plies, mbd.deg([*half, *(-x for x in half)]))


def channel(
    turn: float = 0.0, shift: tuple[float, float] = (0.0, 0.0), cells: tuple[int, int, int] = (16, 30, 3)
) -> Section:
    """ANBA4's channel: back of height 2 at y = 0, flanges of width 1, thickness 0.1, open to +y; then turned and moved."""
    flange, back, through = cells
    t, y, z = 0.1, line(0.1, 1.0, flange, 2), line(-0.9, 0.9, back, 2)
    corner, low, high = line(0.0, t, through, 2), line(-1.0, -0.9, through, 2), line(0.9, 1.0, through, 2)
    grids = [grid(corner, z), *(grid(x, rim) for rim in (low, high) for x in (corner, y))]
    c, s = math.cos(turn), math.sin(turn)
    patches = [Patch(points @ np.array([[c, s], [-s, c]]) + np.array(shift), 0) for points in grids]
    return Section(patch_mesh(patches, 2)[0], Orthotropic.isotropic(1.0, 0.33, 1.0))


def largest_error(K: Tensor, reference: dict[tuple[int, int], float]) -> float:
    """Largest relative difference to the entries of a reference, by their indices from 1."""
    return max(abs(float(K[i - 1, j - 1]) / value - 1.0) for (i, j), value in reference.items())


def general_section(order: int = 2) -> Section:
    """No symmetry at all: unbalanced walls, each with its own plies, on an irregular mesh, off the origin."""
    walls = {"top": [0.3, -0.9], "right": [1.2, 0.1], "bottom": [-0.4, 0.7], "left": [0.8, 0.2]}
    result = sections.box(0.05, 0.03, ANBA, walls, (1.2e-3, 0.8e-3), cells=(5, 4, 1), order=order)
    y, z = result.mesh.nodes.unbind(1)
    moved = torch.stack([y + 0.15 * z + 4.0 * y * z + 0.01, z + 0.1 * y - 0.004], dim=1)
    mesh = SectionMesh(moved, result.mesh.elements, result.mesh.layer)
    return Section(mesh, ANBA, result.angles.detach())


def scaled(K: Tensor) -> Tensor:
    """A matrix with a unit diagonal: its entries are comparable."""
    d = K.diagonal().rsqrt()
    return d[:, None] * K * d
