"""Which minima a study found, how large their basins are, and how many it may have missed.

    expected number of minima  = w (N - 1) / (N - w - 2)           N local searches ended in w distinct minima
    share of the space covered = (N - w - 1) (N + w) / (N (N - 1))

both under a uniform prior on the basins' sizes, for starts drawn uniformly over the bounds.
Source: Boender and Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods, Math. Programming
37 (1987) 59-80.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.optimizer import OptimizationResult


@dataclass(frozen=True)
class Minimum:
    x: np.ndarray
    value: float
    count: int  # searches that ended here: its basin
    starts: list[int]


def distinct_minima(
    results: Sequence[OptimizationResult],
    span: np.ndarray,
    x_tolerance: float = 0.01,
    value_tolerance: float = 1e-3,
    period: np.ndarray | None = None,
) -> list[Minimum]:
    """Return the distinct minima of the converged searches, best first.

    Two ends are one minimum if their values agree to `value_tolerance` (relative; of a thousandth of the start's
    value where the minimum is zero) and each variable to `x_tolerance` of `span` [n]; variables with a `period` [n]
    (0 where none; ply angles: half a turn) are compared on the circle.
    """
    ends = sorted((r for r in results if r.converged), key=lambda r: r.value)
    groups: list[list[OptimizationResult]] = []
    for end in ends:
        for group in groups:
            if _same(group[0], end, span, x_tolerance, value_tolerance, period):
                group.append(end)
                break
        else:
            groups.append([end])
    return [Minimum(group[0].x, group[0].value, len(group), sorted(r.start for r in group)) for group in groups]


def expected_minima(searches: int, minima: int) -> float:
    """Return the Bayesian estimate of how many minima there are; inf while there are too few searches to tell."""
    return minima * (searches - 1) / (searches - minima - 2) if searches > minima + 2 else float("inf")


def covered_share(searches: int, minima: int) -> float:
    """Return the Bayesian estimate of the share of the space whose minima are known; nan with too few searches."""
    if searches < minima + 2:
        return float("nan")
    return (searches - minima - 1) * (searches + minima) / (searches * (searches - 1))


def _same(
    a: OptimizationResult,
    b: OptimizationResult,
    span: np.ndarray,
    x_tolerance: float,
    value_tolerance: float,
    period: np.ndarray | None,
) -> bool:
    distance = np.abs(a.x - b.x)
    if period is not None:
        turn = np.where(period > 0.0, period, np.inf)
        distance = np.minimum(distance % turn, turn - distance % turn)
    near = bool((distance <= x_tolerance * span).all())
    size = max(abs(a.value), abs(b.value), 1e-3 * abs(a.history[0].objective), 1e-3 * abs(b.history[0].objective))
    return near and abs(a.value - b.value) <= value_tolerance * size
