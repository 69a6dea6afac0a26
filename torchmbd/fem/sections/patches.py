"""Structured patches of a section, and how they are joined to a mesh.

A patch is a grid of points [I, J, 2]: quadrilaterals between neighbours, counterclockwise where J lies to the left of I.
With order 2 each element spans two steps of the grid (8 nodes; the middle point is left out). The wall's tangent is I.
Checked in tests/fem/sections/test_section_generators.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchmbd.fem.sections.mesh import SectionMesh

_STEPS = {1: ((0, 0), (1, 0), (1, 1), (0, 1)), 2: ((0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1))}


@dataclass(frozen=True)
class Patch:
    """A grid of points [I, J, 2] of one layer."""

    points: NDArray[np.float64]
    layer: int


def parametric_mesh(
    build: Callable[..., Sequence[Patch]], dimensions: Mapping[str, Any], order: int, plane_angle: float | None = None
) -> SectionMesh:
    """Return the mesh of the patches build(**dimensions), whose points are linear in them [m].

    Dimensions that are Parameters are design variables of the mesh. plane_angle: of all elements
    """
    sizes = {
        name: x.detach().numpy() if isinstance(x, Tensor) else np.asarray(x, float) for name, x in dimensions.items()
    }
    mesh, kept = patch_mesh(build(**sizes), order, plane_angle)
    for name, x in dimensions.items():
        if isinstance(x, nn.Parameter):
            nothing = {other: 0.0 * size for other, size in sizes.items()}
            units = np.eye(x.numel()).reshape(-1, *x.shape)
            points = [_points(build(**nothing | {name: unit}))[kept] for unit in units]
            mesh.dimensions[name] = x, torch.from_numpy(np.stack(points))
    return mesh


def patch_mesh(
    patches: Sequence[Patch], order: int, plane_angle: float | None = None
) -> tuple[SectionMesh, NDArray[np.int64]]:
    """Return the mesh of patches and the indices of its nodes among all points.

    Points that agree to a millionth of the smallest element are one node.
    """
    elements, layer, start = [], [], 0
    for patch in patches:
        rows, columns = patch.points.shape[:2]
        i, j = np.meshgrid(np.arange(0, rows - 1, order), np.arange(0, columns - 1, order), indexing="ij")
        block = np.stack([start + (i + a) * columns + (j + b) for a, b in _STEPS[order]], axis=-1)
        elements.append(block.reshape(-1, block.shape[-1]))
        layer.append(np.full(i.size, patch.layer))
        start += rows * columns
    nodes, elements = _points(patches), np.concatenate(elements)
    corners = nodes[elements]
    size = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1).min()
    _, first, inverse = np.unique(np.round(nodes / (1e-6 * size)), axis=0, return_index=True, return_inverse=True)
    used, connectivity = np.unique(inverse.ravel()[elements], return_inverse=True)
    kept = first[used]
    mesh = SectionMesh(nodes[kept], connectivity.reshape(elements.shape), np.concatenate(layer), plane_angle)
    return mesh, kept


def _points(patches: Sequence[Patch]) -> NDArray[np.float64]:
    return np.concatenate([patch.points.reshape(-1, 2) for patch in patches])


def line(start: float, end: float, cells: int, order: int) -> NDArray[np.float64]:
    """Return equally spaced node positions of `cells` elements."""
    return np.linspace(start, end, cells * order + 1)


def graded(start: float, end: float, cells: int, order: int) -> NDArray[np.float64]:
    """Return node positions of `cells` elements that become short towards both ends: warping bends most near corners."""
    ends = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, cells + 1))
    share = ends if order == 1 else np.insert(ends, np.arange(1, cells + 1), (ends[1:] + ends[:-1]) / 2)
    return start + (end - start) * share


def grid(y: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points [I, J, 2] at y[i], z[j]."""
    return np.stack(np.meshgrid(y, z, indexing="ij"), axis=-1)


def between(low: NDArray[np.float64], high: NDArray[np.float64], cells: int, order: int) -> NDArray[np.float64]:
    """Points [I, J, 2] on the straight lines from low [I, 2] to high [I, 2]."""
    t = np.linspace(0.0, 1.0, cells * order + 1)[None, :, None]
    return low[:, None] * (1 - t) + high[:, None] * t
