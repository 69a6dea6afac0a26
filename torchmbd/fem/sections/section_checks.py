"""Checks of the dimensions, plies and numbers of elements of sections (generators.py).

Checked in tests/fem/sections/test_section_generators.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.math.checked_numbers import is_whole, positive
from torchmbd.math.plausible_units import DIMENSION, THICKNESS, warn_unusual
from torchmbd.math.variable import number

Angles = Sequence[float] | Tensor
WALLS = ("top", "right", "bottom", "left")


def angles_of_walls(angles: Angles | Mapping[str, Angles]) -> Mapping[str, Angles]:
    if not isinstance(angles, Mapping):
        return dict.fromkeys(WALLS, angles)
    check_names(angles, WALLS)
    return angles


def count_of_layers(angles: Any) -> int:
    """Return the number of plies; InputError where angles are no list."""
    if isinstance(angles, str) or not hasattr(angles, "__len__") or getattr(angles, "ndim", 1) != 1:
        raise InputError(f"angles is {angles!r}; allowed: one angle per ply, such as mbd.deg([45, -45]) [rad]")
    return len(angles)


def check_names(angles: Mapping[str, Angles], names: Sequence[str]) -> None:
    if not isinstance(angles, Mapping):
        raise InputError(f"angles is {angles!r}; allowed: a mapping with {', '.join(names)}")
    for name in angles:
        if name not in names:
            raise unknown("wall", name, names)
    counts = {name: count_of_layers(angles[name]) if name in angles else 0 for name in names}
    if len(set(counts.values())) > 1 or 0 in counts.values():
        raise InputError(f"angles give {counts} plies; allowed: as many plies in {', '.join(names)}")


def checked_thicknesses(thickness: float | Sequence[float] | Tensor, layers: int) -> np.ndarray:
    t = np.asarray(thickness.detach() if isinstance(thickness, Tensor) else thickness, dtype=float)
    t = np.repeat(t, layers) if t.ndim == 0 else t
    if t.shape != (layers,) or layers == 0:
        raise InputError(f"{t.size} thicknesses for {layers} plies; allowed: one number, or one per ply [m]")
    if not (np.isfinite(t) & (t > 0)).all():
        raise InputError(f"thickness = {thickness!r}; allowed: finite numbers > 0 [m]")
    warn_unusual("thickness", float(t.max()), "m", THICKNESS)
    return t


def check_lengths(**lengths: float | Tensor) -> None:
    for name, value in lengths.items():
        warn_unusual(name, positive(name, number(value), "m"), "m", DIMENSION)


def check_cells(cells: Sequence[int], count: int, order: int) -> None:
    if not (isinstance(cells, Sequence) and len(cells) == count and all(is_whole(c) and c >= 1 for c in cells)):
        raise InputError(f"cells = {cells!r}; allowed: {count} integers >= 1")
    check_order(order)


def check_order(order: int) -> None:
    """InputError unless elements are linear (1) or quadratic (2)."""
    if order not in (1, 2):
        raise InputError(f"order = {order!r}; allowed: 1 (linear elements) or 2 (quadratic)")
