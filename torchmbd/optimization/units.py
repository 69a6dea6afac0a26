"""In which unit numbers are measured that may have any sign and a constant part: by what the variables change.

    change = max_i |df/dx_i| size_i       first-order change of f where a variable changes by its size

The magnitude |f| is a unit as long as it lies near this change. A value near zero, such as a coordinate, or a value with a
large constant part, such as a height above the sea, says nothing about what the variables change.
Checked in tests/contracts/test_invariance.py.
"""

from __future__ import annotations

import numpy as np

# |f| is the unit between these multiples of the change.
LEAST, MOST = 0.1, 1.0
# Changes below this share of |f| come of a start that is nearly stationary, or of a constant part: a neighbor tells.
SMALL = 1e-3
ROUNDING = 1e-9  # changes below this share of |f| are none
PERTURBATION = 0.05  # of each variable's size, to the neighbor
# Share of the start's range between bounds: a smaller start, such as an angle of 0.1 degrees, is no measure of its variable.
TINY_START = 0.05


def variable_scale(start: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return |start| [n], or the bound range where |start| is tiny beside it (1 where the variable has no range)."""
    size = np.abs(start)
    span = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    scale = np.where(size > TINY_START * span, size, span)
    return np.where(scale > 0.0, scale, 1.0)


def first_order_change(gradient: np.ndarray, size: np.ndarray) -> float:
    """Return the largest change of a function with this gradient [n] where a variable changes by its size [n]."""
    return float(np.abs(gradient * size).max(initial=0.0))


def needs_neighbor(value: float, change: float) -> bool:
    """Return whether the change at one design is too small beside the value to be that of its surroundings."""
    return not change > SMALL * abs(value)


def neighbor(x: np.ndarray, lower: np.ndarray, upper: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return a design [n] near x inside the bounds, which has none of its symmetries.

    size  of each variable [n]
    """
    share = 1.0 / np.sqrt(1.0 + np.arange(x.size))
    inward = np.where(upper - x >= x - lower, 1.0, -1.0)
    return np.clip(x + PERTURBATION * share * inward * size, lower, upper)


def unit_of(value: float, change: float, most: float = MOST) -> float:
    """Return the unit of a function: |value|, kept near its change; positive. 1 where it is zero and does not change.

    most  multiple of the change that it may be
    """
    if not change > ROUNDING * abs(value):
        return abs(value) or 1.0
    return float(np.clip(abs(value), LEAST * change, most * change))
