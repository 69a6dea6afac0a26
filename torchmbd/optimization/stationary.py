"""Starts where the gradient vanishes although they are no minima.

Ply angles of 0 or 90 degrees are stationary by symmetry, often as a maximum, and no first-order method moves from
there. One more design is evaluated, near the start and inside the bounds: if it is better and feasible, the search begins
there.
"""

from __future__ import annotations

import numpy as np

from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

STATIONARY = 1e-6  # Kuhn-Tucker residual


def perturb_stationary_start(search: Search, first: Evaluation) -> tuple[np.ndarray, Evaluation]:
    """Return design [n] and evaluation to begin with: the start, unless it is stationary and a design near it is better."""
    y = search.start
    if search.kuhn_tucker(first, y).residual > STATIONARY:
        return y, first
    assert first.objective_gradient is not None
    perturbed = search.neighbor
    evaluation = search.evaluate(perturbed, gradients=True)
    better = evaluation.ok and evaluation.objective < first.objective - 1e-12 * max(1.0, abs(first.objective))
    if not better or search.violation(evaluation) > max(search.feasibility, search.violation(first)):
        return y, first
    search.record(perturbed)
    return perturbed, evaluation
