"""The interval of one unknown by its profile likelihood.

    D(p) = min over the others of 2 cost(b_i = p, others) - 2 cost(b)        (divided by kappa where deviations are estimated)
    interval: D(p) <= F(level; 1, N - n)

Each D(p) is a fit of the other unknowns, from those of the p before. The ends are found by Brent's method on
sqrt(D(p)) - sqrt(F), nearly linear in p. Where it is not reached at a bound, or 32 half widths of the linearized interval
away, the end is the bound or infinite.
Source: Venzon and Moolgavkar, Applied Statistics 37 (1988) 87-94. Checked in tests/extensions/identification/test_profile.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchmbd.extensions.identification.least_squares import Evaluate, Fit, FitSettings, fit_start

_FARTHEST = 32.0  # half widths of the linearized interval
_ACCURACY = 0.01  # of the half width
_EVALUATIONS = 30  # of each fit of the others


def profile_interval(
    evaluate: Evaluate, settings: FitSettings, fit: Fit, index: int, limit: float, deviation: float, kappa: float
) -> tuple[float, float]:
    """The interval of an unknown.

    evaluate, settings, fit   the fit of all unknowns
    index       of the unknown
    limit       of sqrt(D): the quantile of Student's t, whose square is F with 1 and N - n degrees of freedom
    deviation   of the unknown, linearized: how far to look
    kappa       factor of the variances
    """

    def end(sign: float) -> float:
        return _end(evaluate, settings, fit, index, limit, deviation, kappa, sign)

    return end(-1.0), end(1.0)


def _end(
    evaluate: Evaluate,
    settings: FitSettings,
    best: Fit,
    index: int,
    limit: float,
    deviation: float,
    kappa: float,
    sign: float,
) -> float:
    """The end below (-1) or above (1)."""
    from scipy.optimize import brentq

    width, size = limit * deviation, float(np.fmax(best.scale[index], abs(best.x[index]))) or 1.0
    width = width if np.isfinite(width) and width > 0.0 else 0.1 * size
    bound = float(settings.lower[index] if sign < 0.0 else settings.upper[index])
    start, value = best.x.copy(), float(best.x[index])

    def excess(distance: float) -> float:
        nonlocal start
        x = start.copy()
        x[index] = p = value + sign * distance
        lower, upper = settings.lower.copy(), settings.upper.copy()
        lower[index] = upper[index] = p
        limits = replace(settings, lower=lower, upper=upper, max_evaluations=_EVALUATIONS)
        fit = fit_start(evaluate, x, limits)
        if not np.isfinite(fit.cost):
            return np.inf  # no model there: the end is before
        start = fit.x
        return float(np.sqrt(max(2.0 * (fit.cost - best.cost), 0.0) / kappa)) - limit

    inner, outer = 0.0, width
    most = abs(bound - value)
    while True:
        outer = min(outer, most)
        if excess(outer) > 0.0:
            break
        if outer >= most:
            return bound
        if outer >= _FARTHEST * width:
            return sign * np.inf
        inner, outer = outer, 2.0 * outer
    start = best.x.copy()
    values = {0.0: -limit}

    def bounded(distance: float) -> float:
        if distance not in values:
            value = excess(distance)
            values[distance] = value if np.isfinite(value) else 10.0 * limit
        return values[distance]

    distance: float = brentq(bounded, inner, outer, xtol=_ACCURACY * width)  # pyright: ignore[reportAssignmentType]
    return value + sign * distance
