"""Fields over the cells of a mesh: numbers at control points, interpolated to the middles of the cells.

    value of cell c = sum_k W_ck p_k            slope of cell c = sum_k grad W_ck p_k

splines   W = products of B-splines of a degree over the rectangle of the cells' middles, along two axes of the mesh:
          uniform knots, clamped at the ends, m x n controls; control (i, j) is number i n + j
radial    W = phi(|x_c - x_k| / r) / sum of these over k,  phi(s) = (1 - s)^4 (4 s + 1) for s < 1, else 0: for shells of any
          form. With the middles of the cells as controls this is a filter of radius r, which no finer pattern passes.

W adds up to one in each cell, and is never negative, so values stay between the least and the largest control.
Source: de Boor, A Practical Guide to Splines (1978), chapter IX; Wendland, Piecewise polynomial, positive definite and
compactly supported radial functions of minimal degree, Adv. Comput. Math. 4 (1995) 389-396; Shepard (1968).
Checked in tests/extensions/fibers/test_field.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.interpolate import BSpline
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.mesh import Mesh
from torchmbd.math.checked_numbers import indices, is_real, is_whole, reals
from torchmbd.math.gradients import constant_arguments

AXES = "xyz"


class FiberField:
    """Control points, and the weights by which the values of the cells of a mesh follow from them.

    mesh      the mesh whose cells get values
    controls  (m, n) control points of a spline along two axes of the mesh, or places [k, 3] [m] of radial functions,
              or "cells": the middle of every cell
    radius    of radial functions [m]; every cell needs a control nearer than that
    degree    of the spline, at most one less than the controls along that axis
    axes      the two axes of the mesh; None: those along which it is longest
    cells     numbers of the cells that get values; None: all

    For each cell, only the r controls near it are kept:
    nearest   their numbers [cells, r]
    weights   W of these [cells, r]
    slopes    gradient of W in mesh axes [cells, 3, r] [1/m]

    >>> mesh = mbd.mesh.rectangle(0.4, 0.1, cells=(16, 4))
    >>> field = mbd.fibers.FiberField(mesh, controls=(5, 3))
    >>> field
    FiberField(15 controls, 64 cells)
    >>> laminate = mbd.fibers.SteeredLaminate(mbd.examples.carbon(), mbd.deg([30, -30]), thickness=1e-3, field=field)
    >>> laminate.angles.shape  # of each control, [rad]
    torch.Size([15, 2])
    """

    nearest: Int[Tensor, "cells r"]
    weights: Float[Tensor, "cells r"]
    slopes: Float[Tensor, "cells 3 r"]

    @constant_arguments
    def __init__(
        self,
        mesh: Mesh,
        controls: Sequence[int] | Sequence[Sequence[float]] | Tensor | str,
        radius: float | None = None,
        degree: int = 2,
        axes: str | None = None,
        cells: Sequence[int] | Tensor | None = None,
    ) -> None:
        if not isinstance(mesh, Mesh) or not mesh.cell_count:
            raise InputError("mesh", mesh, "a Mesh with cells", noun="mesh of a FiberField")
        self.mesh, self.cells = mesh, _cells(mesh, cells)
        places = _middles(mesh)[self.cells]
        if radius is None:
            m, n = _counts(controls)
            along = _axes(places, axes)
            arrays = _spline(places[:, along].numpy(), (m, n), _degree(degree, (m, n)))
            W, in_plane = (torch.as_tensor(x) for x in arrays)
            slopes = torch.zeros(len(places), 3, m * n, dtype=torch.float64)
            slopes[:, along] = in_plane
        else:
            if axes is not None:
                raise InputError(
                    "axes", axes, "None, because it has no axes", state=f"is {axes!r} of a FiberField with a radius"
                )
            W, slopes = _radial(places, _points(controls, places), _radius(radius))
        self.controls = W.shape[1]
        used = (W != 0.0) | (slopes != 0.0).any(1)
        count = int(used.sum(1).max())
        self.nearest = used.double().topk(count, dim=1).indices
        self.weights = W.gather(1, self.nearest)
        self.slopes = slopes.gather(2, self.nearest[:, None].expand(-1, 3, -1))

    def __repr__(self) -> str:
        return f"FiberField({self.controls} controls, {len(self.cells)} cells)"

    def values(self, p: Float[Tensor, "*lanes controls layers"]) -> Float[Tensor, "*lanes cells layers"]:
        """The field in the middle of each cell."""
        return (self.weights[..., None] * p[..., self.nearest, :]).sum(-2)

    def gradients(self, p: Float[Tensor, "*lanes controls layers"]) -> Float[Tensor, "*lanes cells layers 3"]:
        """The gradient of the field in the middle of each cell, in mesh axes [1/m]."""
        return torch.einsum("cxr,...crk->...ckx", self.slopes, p[..., self.nearest, :])

    def zones(self, mesh: Mesh, cells: Int[Tensor, " cells"]) -> Int[Tensor, " cells"]:
        """Row of the field for each cell of a plate. Raises InputError if the field belongs to other cells."""
        if mesh is not self.mesh:
            raise InputError(
                "field",
                allowed=f"made with the mesh of the body, {mesh!r}",
                state=f"was made with another mesh, {self.mesh!r}",
                noun="field of a laminate",
            )
        row = torch.full((mesh.cell_count,), -1).index_copy(0, self.cells, torch.arange(len(self.cells)))[cells]
        if len(cells) != len(self.cells) or bool((row < 0).any()):
            raise InputError(
                "field",
                allowed=f"made for the {len(cells)} cells of this laminate",
                state=f"was made for {len(self.cells)} other cells",
                noun="field of a laminate",
            )
        return row


def _cells(mesh: Mesh, cells: Sequence[int] | Tensor | None) -> Tensor:
    if cells is None:
        return torch.arange(mesh.cell_count)
    numbers = indices("cells", cells)
    if numbers.ndim != 1 or not len(numbers) or int(numbers.min()) < 0 or int(numbers.max()) >= mesh.cell_count:
        raise InputError("cells", cells, f"numbers of cells, 0 to {mesh.cell_count - 1}", noun="cells of a FiberField")
    if len(numbers.unique()) < len(numbers):
        raise InputError(
            "cells", cells, "must contain each number once", noun="cells of a FiberField", state="has a number twice"
        )
    return numbers


def _middles(mesh: Mesh) -> Float[Tensor, "cells 3"]:
    """Mean of the corners of every cell [m]."""
    return torch.cat([mesh.nodes[corners].mean(1) for corners in mesh.cells.values() if len(corners)])


def _counts(controls: object) -> tuple[int, int]:
    if (
        isinstance(controls, Sequence)
        and len(controls) == 2
        and all(is_whole(x) and x >= 1 for x in controls)  # one control: constant along that axis
    ):
        return int(controls[0]), int(controls[1])
    raise InputError(
        "controls",
        controls,
        "two whole numbers >= 1, or with a radius places [k, 3] or 'cells'",
        noun="controls of a FiberField",
    )


def _degree(degree: int, counts: tuple[int, int]) -> int:
    if not (is_whole(degree) and 0 <= degree <= 5):
        raise InputError("degree", degree, "0 to 5", noun="degree of a FiberField")
    if any(1 < n <= degree for n in counts):
        raise InputError(
            "controls",
            counts,
            f"1, or at least {degree + 1} along an axis for degree {degree}",
            noun="controls of a FiberField",
        )
    return int(degree)


def _radius(radius: float) -> float:
    if not (is_real(radius) and 0.0 < radius < float("inf")):
        raise InputError("radius", radius, "a finite number > 0", noun="radius of a FiberField", shown=f"{radius!r} m")
    return float(radius)


def _axes(places: Tensor, axes: str | None) -> list[int]:
    if axes is None:
        extent = places.amax(0) - places.amin(0)
        return sorted(extent.argsort(descending=True, stable=True)[:2].tolist())
    if not isinstance(axes, str) or len(axes) != 2 or axes[0] == axes[1] or not set(axes) <= set(AXES):
        raise InputError("axes", axes, "two of x, y, z, such as 'xy'", noun="axes of a FiberField")
    return [AXES.index(x) for x in axes]


def _points(controls: object, places: Tensor) -> Tensor:
    if isinstance(controls, str):
        if controls != "cells":
            raise InputError("controls", controls, "'cells', or places [k, 3]", noun="controls of a FiberField")
        return places
    points = reals("controls", controls)  # pyright: ignore[reportArgumentType]
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not points.isfinite().all():
        raise InputError(
            "controls",
            allowed="places [k, 3], or 'cells', with a radius",
            state=f"has shape {tuple(points.shape)}",
            noun="controls of a FiberField",
        )
    return points


def _spline(at: np.ndarray, counts: tuple[int, int], degree: int) -> tuple[np.ndarray, np.ndarray]:
    """W [cells, controls] and its two slopes [cells, 2, controls]."""
    (A, dA), (B, dB) = (_basis(x, n, degree) for x, n in zip(at.T, counts, strict=True))
    W, Wx, Wy = ((a[:, :, None] * b[:, None, :]).reshape(len(at), -1) for a, b in ((A, B), (dA, B), (A, dB)))
    return W, np.stack([Wx, Wy], 1)


def _basis(x: np.ndarray, count: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """B-splines [places, count] from the first to the last place, and their slopes."""
    low, high = x.min(), x.max()
    if count == 1:
        return np.ones((len(x), 1)), np.zeros((len(x), 1))
    if not high > low:
        raise InputError(
            "controls",
            count,
            "1",
            state=f"has {count} along an axis where the cells have no extent",
            noun="controls of a FiberField",
        )
    ends = [np.full(degree, low), np.linspace(low, high, count - degree + 1), np.full(degree, high)]
    basis = BSpline(np.concatenate(ends), np.eye(count), degree)
    slope = basis.derivative()(x) if degree else np.zeros((len(x), count))
    return basis(x), slope


def _radial(places: Tensor, points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """W [cells, controls] and its gradient [cells, 3, controls]."""
    arm = places[:, None] - points
    s = (arm.norm(dim=-1) / radius).clamp(max=1.0)
    phi, slope = (1 - s) ** 4 * (4 * s + 1), (-20.0 * (1 - s) ** 3 / radius**2)[..., None] * arm
    total = phi.sum(1, keepdim=True)
    no_control = (total[:, 0] == 0.0).nonzero().flatten()
    if len(no_control):
        raise InputError(
            "radius",
            radius,
            "must reach a control point from every cell",
            noun="radius of a FiberField",
            state=f"is {radius!r} m, and cell {int(no_control[0])} and {len(no_control) - 1} other cells do "
            "not have a control point within it",
            hint="a larger radius, or more controls",
        )
    W = phi / total
    return W, (slope.mT - W[:, None] * slope.sum(1)[..., None]) / total[:, None]
