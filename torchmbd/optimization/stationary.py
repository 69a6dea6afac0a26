"""Leave a start where the gradient vanishes although it is no minimum.

Ply angles of 0 or 90 degrees are stationary by symmetry, often as a maximum, and no first-order method moves from
there. One more analysis, a little aside and inwards, tells: if it is better and feasible, the search begins there.
"""

from __future__ import annotations

import numpy as np

from torchmbd.optimization.kkt import kuhn_tucker
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

STATIONARY = 1e-6  # Kuhn-Tucker residual
ASIDE = 0.05  # of each variable's size


def departure(search: Search, first: Evaluation) -> tuple[np.ndarray, Evaluation]:
    """Return design and evaluation to begin with: the start, unless it is stationary and a point aside is better."""
    y = search.start
    here = y, first
    if kuhn_tucker(first, y, search.lower, search.upper, search.equality).residual > STATIONARY:
        return here
    assert first.objective_gradient is not None
    # Unequal shares, so that no symmetry of the variables is kept.
    share = 1.0 / np.sqrt(1.0 + np.arange(search.size))
    inward = np.where(search.upper - y >= y - search.lower, 1.0, -1.0)
    aside = np.clip(y + ASIDE * share * inward * np.maximum(np.abs(y), 1.0), search.lower, search.upper)
    tried = search.evaluate(aside, gradients=True)
    better = tried.ok and tried.objective < first.objective - 1e-12 * max(1.0, abs(first.objective))
    if not better or search.violation(tried) > max(search.feasibility, search.violation(first)):
        return here
    search.record(aside)
    return aside, tried
