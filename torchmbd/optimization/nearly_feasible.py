"""A feasible end of a search, made of a design that violates the constraints by little.

Many methods meet the constraints at their end only: where one stops earlier, its best design may violate a limit by a hundredth
of a percent, and the best feasible design may be the start. So a design d away is evaluated,

    minimize |d|^2   subject to   c_i + dc_i . d <= -MARGIN c_i (violated),  <= 0 (others),   lower <= y + d <= upper

and corrected again while it is not feasible. y is the least violated among the designs that promise the lowest objective
f + df . d. Nothing is evaluated where none promises GAIN below the best feasible design. A search that may not evaluate any
more says in its message what it knows.
Checked in tests/optimization/test_nearly_feasible.py, and over the registry in tests/contracts/test_optimizers.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.kkt import SMALLEST_OBJECTIVE
from torchmbd.optimization.methods.quadratic import solve_quadratic
from torchmbd.optimization.optimizer import MOST_DENSE, Evaluation
from torchmbd.optimization.search import Search

NEAR = 1e-2  # violation from which on a first-order correction says little
GAIN = 1e-3  # of the objective
SIMILAR = 1e-2  # of the objective: promises that differ by less are equal
MARGIN = 0.1  # of the violation: a convex constraint is violated again where its linearization is met
CORRECTIONS = 4


@dataclass(frozen=True)
class Candidate:
    """A nearly feasible design y [n] with its largest violation, its correction d [n], and f + df . d (scaled)."""

    y: np.ndarray
    violation: float
    d: np.ndarray
    promise: float


def most_promising(search: Search) -> Candidate | None:
    """Return the nearly feasible design that promises the most; None if none promises GAIN below the best feasible one.

    Corrections have matrices of n x n numbers, so none is made for many variables.
    """
    if search.size > MOST_DENSE:
        return None
    known = [candidate for y in search.nearly_feasible(NEAR) if (candidate := _candidate(search, y)) is not None]
    best = None if search.best is None else search.evaluate_known(search.best)
    if best is not None and search.violation(best) <= search.feasibility:
        limit = best.objective - GAIN * max(abs(best.objective), SMALLEST_OBJECTIVE)
        known = [candidate for candidate in known if candidate.promise < limit]
    if not known:
        return None
    lowest = min(candidate.promise for candidate in known)
    similar = lowest + SIMILAR * max(abs(lowest), SMALLEST_OBJECTIVE)
    return min((x for x in known if x.promise <= similar), key=lambda x: x.violation)


def make_feasible(search: Search) -> bool:
    """Evaluate corrections of the most promising design; return whether one is feasible. It is then the search's best."""
    candidate = most_promising(search)
    for _ in range(CORRECTIONS):
        if candidate is None:
            return False
        y = np.clip(candidate.y + candidate.d, search.lower, search.upper)
        evaluation = search.evaluate(y, gradients=True)
        if not evaluation.ok:
            return False
        if search.violation(evaluation) <= search.feasibility:
            return True
        candidate = _candidate(search, search.tightened(y))
    return False


def _candidate(search: Search, y: np.ndarray) -> Candidate | None:
    """The candidate of a design that was evaluated; None without gradients, or if no step meets all limits to first order."""
    evaluation = search.evaluate_known(y)
    if not evaluation.ok or evaluation.objective_gradient is None:
        return None
    d = _correction(search, y, evaluation)
    if d is None:
        return None
    promise = evaluation.objective + float(evaluation.objective_gradient @ d)
    return Candidate(y, search.violation(evaluation), d, promise)


def _correction(search: Search, y: np.ndarray, evaluation: Evaluation) -> np.ndarray | None:
    c, dc = evaluation.constraints, evaluation.constraint_gradients
    assert dc is not None
    equal = search.equality
    identity = np.eye(y.size)
    above, below = np.isfinite(search.upper), np.isfinite(search.lower)
    rows = np.vstack([dc, -dc[equal], identity[above], -identity[below]])
    margin = np.where(equal, 0.0, MARGIN * np.maximum(c, 0.0))
    room = np.concatenate([-c - margin, c[equal], (search.upper - y)[above], (y - search.lower)[below]])
    length = np.linalg.norm(rows, axis=1)
    length[length == 0.0] = 1.0
    solution = solve_quadratic(identity, np.zeros(y.size), rows / length[:, None], room / length)
    return None if solution is None else solution.s
