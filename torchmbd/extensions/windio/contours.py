"""Contours of a blade: airfoils along the span, blended between by their relative thickness.

The thickness is a table of the file, linear along the span, or monotone cubic through the airfoils that are placed. Contours
are linear in it between the two airfoils that it lies between, or linear along the span if the two have one thickness.
Checked in tests/extensions/test_windio.py, tests/extensions/test_windio_versions.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from torchmbd.errors import InputError
from torchmbd.extensions.windio.span_values import span_values

_POINTS = 200  # of a contour
_ROUNDING = 1e-3  # of the relative thickness: a table may leave the airfoils' range by that
Array = NDArray[np.float64]


class Contours:
    """Contours at parts of the span.

    labels      names of airfoils along the span
    positions   parts of the span where they lie; None where the thickness alone places them
    airfoils    name -> coordinates, and relative_thickness
    thickness   table of the relative thickness along the span, which places airfoils where there is one
    Raises InputError that names what cannot be placed.
    """

    def __init__(
        self,
        labels: Sequence[str],
        positions: Sequence[float] | None,
        airfoils: Mapping[str, Any],
        thickness: Mapping[str, Any] | None = None,
    ) -> None:
        self._labels = list(labels)
        self._thicknesses = np.array([float(airfoils[name]["relative_thickness"]) for name in labels])
        shapes = {name: _resampled(name, airfoils[name]["coordinates"]) for name in dict.fromkeys(labels)}
        self._profiles = [shapes[name] for name in labels]
        self._grid = None
        if positions is not None:
            along = span_values(("airfoils", "spanwise_position"), {"grid": positions, "values": self._thicknesses})
            self._grid = along.grid
            self._relative = along if len(labels) == 1 else PchipInterpolator(along.grid, along.values)
        if thickness is not None:
            self._relative = span_values(("rthick",), thickness)
        elif positions is None:
            raise InputError(
                "airfoils", allowed="must have one of them", state="have neither spanwise_position nor rthick"
            )
        steps = np.diff(self._thicknesses)
        if positions is None and not ((steps <= 0.0).all() or (steps >= 0.0).all()):
            raise InputError(
                "airfoils",
                hint="spanwise_position",
                noun="airfoils without spanwise_position",
                allowed="must only rise or only fall along the span",
                state="have relative thicknesses that rise and fall",
            )

    def __call__(self, position: float) -> Array:
        """Points [n, 2] of the contour over the chord: x from the leading edge, y to the suction side."""
        t = self._thicknesses
        if len(t) == 1:
            return self._profiles[0]
        if self._grid is not None:
            position = float(np.clip(position, self._grid[0], self._grid[-1]))
        relative = float(self._relative(position))
        k = self._pair(position, relative)
        if t[k] != t[k + 1]:
            share = float(np.clip((relative - t[k]) / (t[k + 1] - t[k]), 0.0, 1.0))
        elif self._grid is not None and self._grid[k + 1] > self._grid[k]:
            share = float(np.clip((position - self._grid[k]) / (self._grid[k + 1] - self._grid[k]), 0.0, 1.0))
        else:
            share = 0.0
        return self._profiles[k] + share * (self._profiles[k + 1] - self._profiles[k])

    def _pair(self, position: float, relative: float) -> int:
        """Return the first of two airfoils that a thickness lies between, the nearest such pair along the span."""
        low, high = np.sort(np.stack([self._thicknesses[:-1], self._thicknesses[1:]]), axis=0)
        outside = np.maximum(np.maximum(low - relative, relative - high), 0.0)
        if outside.min() > _ROUNDING:
            raise InputError(
                "rthick",
                relative,
                f"must lie between {low.min():g} and {high.max():g}, the range of the airfoils",
                noun=f"rthick at {position:g}",
                state=f"is {relative:g}",
            )
        near = outside <= outside.min() + _ROUNDING * 1e-6
        if self._grid is None:
            return int(np.argmax(near))
        apart = np.maximum(np.maximum(self._grid[:-1] - position, position - self._grid[1:]), 0.0)
        return int(np.argmin(np.where(near, apart, np.inf)))


def _resampled(name: str, coordinates: Mapping[str, Any]) -> Array:
    """Return a contour at _POINTS positions from the trailing edge over the suction side, at the same x on both sides."""
    rows = [np.array(coordinates[axis], dtype=float) for axis in "xy"]
    if rows[0].ndim != 1 or rows[0].shape != rows[1].shape or not np.isfinite(rows).all():
        raise InputError(
            ("airfoils", name, "coordinates"),
            [row.shape for row in rows],
            "equal numbers of x and y, all finite",
            noun=f"coordinates of airfoil {name!r}",
            state=f"are {[row.shape for row in rows]} numbers",
        )
    points = np.stack(rows, 1)
    if len(np.unique(points[:, 0])) < 3 or points[:, 0].argmin() in (0, len(points) - 1):
        raise InputError(
            ("airfoils", name, "coordinates"),
            allowed="must run from the trailing edge and back",
            noun=f"coordinates of airfoil {name!r}",
            state="do not run around it",
        )
    nose = int(points[:, 0].argmin())
    halves = [points[: nose + 1], points[nose:][::-1]]
    if halves[0][:, 1].mean() < halves[1][:, 1].mean():
        halves = halves[::-1]
    x = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, _POINTS // 2))
    sides = []
    for half in halves:
        side = half[np.argsort(half[:, 0], kind="stable")]
        keep = np.concatenate([[True], np.diff(side[:, 0]) > 1e-9])
        sides.append(PchipInterpolator(side[keep, 0], side[keep, 1])(np.clip(x, side[keep, 0][0], side[keep, 0][-1])))
    suction, pressure = sides
    return np.concatenate([np.stack([x, suction], 1)[::-1], np.stack([x, pressure], 1)[1:]])
