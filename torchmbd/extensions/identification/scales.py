"""Units of the unknowns of a fit: a fit is the same in all units of its data and of its unknowns.

    s_i = |b_i|                                         a start that says how large an unknown is
    s_i = (|r|^2 + N)^1/2 / |J_i|                       a start at zero, an offset, a delay: the change that alone could explain
                                                        the residuals

r, J  residuals [N] at the start and their derivatives, in deviations of the noise. N is what noise alone adds to |r|^2.
No unit is larger than the range between the bounds.
Checked in tests/extensions/identification/test_invariance.py.
"""

from __future__ import annotations

import numpy as np

from torchmbd.optimization.units import TINY_START


def scale_of_start(start: np.ndarray, lower: np.ndarray, upper: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Units [n] by the start alone; nan where it is zero, or tiny beside the range, and the data must say it.

    origins   which unknowns [n] are offsets and delays, whose start does not say how much they change
    """
    span = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    return np.where((np.abs(start) > TINY_START * span) & ~origins, np.abs(start), np.nan)


def scale_of_data(
    scale: np.ndarray, x: np.ndarray, lower: np.ndarray, upper: np.ndarray, values: np.ndarray, jacobian: np.ndarray
) -> np.ndarray:
    """Units [n] with those that are nan by the residuals [N] and their Jacobian [N, n]; nan where a column is zero."""
    norms = np.linalg.norm(jacobian, axis=0)
    size = np.sqrt(float(values @ values) + len(values))
    with np.errstate(divide="ignore"):
        by_data = np.where(norms > 0.0, np.maximum(size / norms, np.abs(x)), np.nan)
    return np.where(np.isnan(scale), np.fmin(by_data, np.where(upper > lower, upper - lower, np.inf)), scale)
