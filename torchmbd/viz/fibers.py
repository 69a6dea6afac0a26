"""The fibers of a laminated shell: one picture for each layer, a line in each cell along its fibers.

Cells and lines are polygons of one collection, which matplotlib draws from the farthest to the nearest, so cells hide the
lines behind them. Checked in tests/viz/test_fibers.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.process import imports
from torchmbd.viz.figures import BEST

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = 3
_LENGTH, _WIDTH = 0.8, 0.08  # of a line, shares of the root of the area of its cell
_LIFT = 0.05  # towards the eye: a line lies above its own cell [share of the root of the area]
_SIZE = 3.4  # of a panel [in]


def fibers(body: Any, layers: Sequence[int] | None = None, view: tuple[float, float] = (25.0, -60.0)) -> Figure:
    """Draw the direction of the fibers of every layer of a laminated plate or shell, in its present design.

    body    a FlexibleBody with plates
    layers  numbers from 1 at the bottom; None: all
    view    elevation over the x-y plane and azimuth from x of the eye [deg]

    >>> figure = mbd.viz.fibers(mbd.examples.arm().body("arm"))
    >>> [axes.get_title() for axes in figure.axes]
    ['layer 1', 'layer 2']
    """
    parts = list(getattr(body, "plates", {}).values())
    if not parts:
        raise InputError("body", body, "a FlexibleBody with laminated plates")
    of_parts = [part.fibers() for part in parts]
    count = max(map(len, of_parts))
    shown = list(range(1, count + 1)) if layers is None else list(layers)
    if not shown or not set(shown) <= set(range(1, count + 1)):
        raise InputError("layers", layers, f"numbers from 1 to {count}")
    with imports():
        from matplotlib.figure import Figure
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    mesh = parts[0].mesh
    nodes = mesh.nodes.detach().numpy()
    corners = [nodes[cell] for kind in mesh.cells.values() for cell in kind.numpy()]
    columns = min(len(shown), _COLUMNS)
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(_SIZE * columns, _SIZE * rows))
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.92, wspace=0.0, hspace=0.1)
    span = np.maximum(np.ptp(nodes, axis=0), 0.02 * np.ptp(nodes, axis=0).max())
    for place, layer in enumerate(shown):
        axes: Any = figure.add_subplot(rows, columns, place + 1, projection="3d", proj_type="ortho")
        lines = []
        for part, directions in zip(parts, of_parts, strict=True):
            if layer <= len(directions):
                lines += fiber_lines(part, corners, directions[layer - 1].numpy(), _eye(*view))
        colors = ["#e8e8e8"] * len(corners) + [BEST] * len(lines)
        edges = ["#c0c0c0"] * len(corners) + ["none"] * len(lines)
        axes.add_collection3d(Poly3DCollection([*corners, *lines], facecolors=colors, edgecolors=edges, linewidths=0.3))
        for set_limits, low, size in zip(
            (axes.set_xlim, axes.set_ylim, axes.set_zlim), nodes.min(0), span, strict=True
        ):
            set_limits(low, low + size)
        axes.set_box_aspect(tuple(span))
        axes.view_init(*view)
        axes.set_axis_off()
        axes.set_title(f"layer {layer}", fontsize=9)
    return figure


def _eye(elevation: float, azimuth: float) -> np.ndarray:
    """Return the unit vector towards the eye."""
    e, a = np.radians([elevation, azimuth])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def fiber_lines(part: Any, corners: Sequence[np.ndarray], directions: np.ndarray, eye: np.ndarray) -> list[np.ndarray]:
    """Return a narrow rectangle [4, 3] along the fibers of each cell of a part."""
    members = part.matrices.members.numpy()
    size = part.mesh.areas.detach().numpy()[members, None] ** 0.5
    normals = part.mesh.normals.detach().numpy()[members]
    centers = np.array([corners[cell].mean(0) for cell in members]) + _LIFT * size * eye
    along, across = 0.5 * _LENGTH * size * directions, 0.5 * _WIDTH * size * np.cross(normals, directions)
    return list(np.stack([centers + s * along + t * across for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))], 1))
