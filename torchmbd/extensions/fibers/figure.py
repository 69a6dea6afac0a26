"""The paths of steered fibers: one picture for each given layer of a flat plate, seen along its normal.

Angles of the cells are averaged at the nodes, and lines follow the direction between them; colors are the curvature of the
paths. Checked in tests/extensions/fibers/test_figure.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchmbd.errors import InputError
from torchmbd.extensions.fibers.steered_laminate import SteeredLaminate
from torchmbd.viz.figures import figure_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FLAT = 1e-6  # largest deviation of normals
_POINTS = 200  # of the grid along the plate


def fiber_paths(body: Any, density: float = 1.0) -> Figure:
    """Draw the fibers of a flat body of one steered laminate, in its present design.

    body     a FlexibleBody
    density  of the lines [-]

    >>> strip = mbd.examples.arm().body("arm").mesh
    >>> laminate = mbd.fibers.SteeredLaminate(
    ...     mbd.examples.carbon(), mbd.deg([45, -45]), 1e-3, mbd.fibers.FiberField(strip, (3, 2), degree=1)
    ... )
    >>> figure = mbd.viz.fiber_paths(mbd.examples.arm(laminate=laminate).body("arm"))
    >>> [axes.get_title() for axes in figure.axes]
    ['layer 1', 'layer 2', '']
    """
    parts = [x for x in getattr(body, "plates", {}).values() if isinstance(x.laminate, SteeredLaminate)]
    if len(parts) != 1:
        raise InputError("body", body, "a FlexibleBody with one steered laminate")
    matrices, laminate = parts[0].matrices, parts[0].laminate
    axes = torch.empty_like(matrices.axes)
    axes[matrices.zones] = matrices.axes
    if float((axes - axes[0]).abs().max()) > _FLAT:
        raise InputError(
            body.name,
            allowed="a flat plate",
            noun=f"body {body.name!r}",
            state="is not flat",
            hint="viz.save_mesh, which writes fibers of any shell",
        )
    with torch.no_grad():
        theta = laminate.field.values(laminate.angles)
        curvature = laminate.paths(axes).curvature.abs()
    plane, at = _plane(matrices, axes[0])
    layers = theta.shape[-1]
    figure, rows = figure_of(0.6 + 1.6 * layers, layers)
    top = max(float(curvature.max()), 1e-9)
    for k, panel in enumerate(rows):
        fields = [at(x[:, k]) for x in (theta.cos(), theta.sin(), curvature)]
        lines = panel.streamplot(
            *plane, *fields[:2], color=fields[2], density=density, arrowsize=0, linewidth=0.8, cmap="viridis"
        )
        lines.lines.set_clim(0.0, top)
        panel.set_aspect("equal")
        panel.set_title(f"layer {k + 1}", fontsize=9)
        panel.set_ylabel("y [m]")
    rows[-1].set_xlabel("x [m]")
    bar = figure.colorbar(lines.lines, ax=rows, label="curvature of paths [1/m]")
    bar.ax.tick_params(labelsize=9)
    return figure


def _plane(matrices: Any, axes: torch.Tensor) -> tuple[tuple[np.ndarray, np.ndarray], Any]:
    """Return the grid x, y along the laminate's axes, and a function that interpolates numbers of cells to its points.

    Points outside of the body are masked.
    """
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    split = {"triangle": [[0, 1, 2]], "quad": [[0, 1, 2], [0, 2, 3]]}
    cuts = [elements.corners[:, part] for kind, elements in matrices.kinds.items() for part in split[kind]]
    used, numbers = torch.cat(cuts).unique(return_inverse=True)
    x, y = (matrices.mesh.nodes[used] @ axes[:2].T).T.numpy()
    triangulation = Triangulation(x, y, numbers.numpy())
    sizes = np.ptp(x), np.ptp(y)
    grid = [
        np.linspace(z.min(), z.max(), max(20, round(_POINTS * size / max(sizes))))
        for z, size in zip((x, y), sizes, strict=True)
    ]
    places = np.meshgrid(*grid)
    rows = matrices.zones.split([len(elements.corners) for elements in matrices.kinds.values()])
    cell = torch.cat([row for row, kind in zip(rows, matrices.kinds, strict=True) for _ in split[kind]])
    count = torch.bincount(numbers.flatten()).double()

    def at(values: torch.Tensor) -> np.ndarray:
        nodal = count.new_zeros(len(used)).index_add(0, numbers.flatten(), values[cell].repeat_interleave(3)) / count
        return LinearTriInterpolator(triangulation, nodal.numpy())(*places)

    return (grid[0], grid[1]), at
