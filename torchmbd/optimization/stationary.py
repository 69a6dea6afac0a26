"""Starts where the gradient vanishes although they are no minima.

Ply angles of 0 or 90 degrees are stationary by symmetry, often as a maximum, and no first-order method moves from
there. One more design is evaluated, near the start and inside the bounds: if it is better and feasible, the search begins
there.
"""

from __future__ import annotations

import numpy as np

from torchmbd.optimization.kkt import kuhn_tucker
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

STATIONARY = 1e-6  # Kuhn-Tucker residual
PERTURBATION = 0.05  # of each variable's size


def perturb_stationary_start(search: Search, first: Evaluation) -> tuple[np.ndarray, Evaluation]:
    """Return design [n] and evaluation to begin with: the start, unless it is stationary and a design near it is better."""
    y = search.start
    if kuhn_tucker(first, y, search.lower, search.upper, search.equality).residual > STATIONARY:
        return y, first
    assert first.objective_gradient is not None
    # Unequal changes of the variables, so that none of their symmetries is kept.
    share = 1.0 / np.sqrt(1.0 + np.arange(search.size))
    inward = np.where(search.upper - y >= y - search.lower, 1.0, -1.0)
    change = PERTURBATION * share * inward * np.maximum(np.abs(y), 1.0)
    perturbed = np.clip(y + change, search.lower, search.upper)
    evaluation = search.evaluate(perturbed, gradients=True)
    better = evaluation.ok and evaluation.objective < first.objective - 1e-12 * max(1.0, abs(first.objective))
    if not better or search.violation(evaluation) > max(search.feasibility, search.violation(first)):
        return y, first
    search.record(perturbed)
    return perturbed, evaluation
