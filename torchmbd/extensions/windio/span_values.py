"""Numbers along the span of a blade: linear between the points of a grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchmbd.errors import InputError, Path

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpanValues:
    """Numbers along the span, linear between the points of a grid."""

    grid: Array
    values: Array

    def __call__(self, at: float, outside: float | None = None) -> float:
        return float(np.interp(at, self.grid, self.values, left=outside, right=outside))


def span_values(path: Path, table: Mapping[str, Any], unit: float = 1.0) -> SpanValues:
    """Read numbers along the span; InputError if grid and values are not as many rising and finite numbers.

    path   the keys to the entry
    table  the entry: `grid` and `values`
    unit   of the file in SI units; values are multiplied by it
    """
    try:
        grid, values = (np.array(table[key], dtype=float) for key in ("grid", "values"))
    except (KeyError, TypeError, ValueError) as error:
        state = f"has other entries: {error!r}"
        raise InputError(path, allowed="must have grid and values, with numbers", state=state) from None
    if grid.ndim != 1 or grid.shape != values.shape or len(grid) < 1 or not (np.diff(grid) >= 0.0).all():
        first = np.atleast_1d(grid).tolist()[:5]
        raise InputError(
            path,
            allowed="must have a rising grid, and a value for each of its places",
            state=f"has grid {first} and {values.size} values",
        )
    if not (np.isfinite(grid).all() and np.isfinite(values).all()):
        raise InputError(path, allowed="must have finite numbers", state="has numbers that are not finite")
    return SpanValues(grid, unit * values)
