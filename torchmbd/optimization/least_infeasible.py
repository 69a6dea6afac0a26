"""The least infeasible design, where no feasible one was found, and the constraints that conflict there.

    minimize t   subject to   c_i(y) <= t  (equalities: |c_i| <= t),   lower <= y <= upper

by feasible directions. The multipliers at the end sum to one. No small change of the design reduces the violation of all
constraints that have a multiplier: these conflict. A design with t <= 0 is feasible after all.
Checked in tests/optimization/test_least_infeasible.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.kkt import kuhn_tucker
from torchmbd.optimization.methods.mmfd import mmfd
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

ITERATIONS = 30
CONFLICT = 1e-2  # multiplier from which on a constraint counts as conflicting


@dataclass(frozen=True)
class LeastInfeasible:
    y: np.ndarray  # scaled
    violation: float  # largest violation of a constraint
    conflicting: list[int]  # indices of the constraints that conflict, ascending


def least_infeasible(search: Search, y: np.ndarray) -> LeastInfeasible:
    """Minimize the largest violation from `y` (scaled), a design that is evaluated already."""
    sign, rows = _rows(search)

    def evaluate(X: np.ndarray, gradients: bool) -> list[Evaluation]:
        designs = [x[:-1] for x in X]
        search.prefetch(designs, gradients)
        return [_lifted(search.evaluate(d, gradients), x[-1], sign, rows) for d, x in zip(designs, X, strict=True)]

    t = search.violation(search.evaluate(y))
    start = np.append(y, t)
    lower, upper = np.append(search.lower, -t), np.append(search.upper, 2.0 * t)
    inner = Search(evaluate, start, lower, upper, feasibility=0.1 * search.feasibility)
    end = mmfd(inner, ITERATIONS).y
    evaluation = search.evaluate(end[:-1], gradients=True)
    violation = search.violation(evaluation)
    y_t, lifted = np.append(end[:-1], violation), _lifted(evaluation, violation, sign, rows)
    quality = kuhn_tucker(lifted, y_t, lower, upper, np.zeros(rows.size, dtype=bool))
    conflicting = sorted(set(rows[quality.multipliers > CONFLICT].tolist()))
    return LeastInfeasible(end[:-1], violation, conflicting)


def _rows(search: Search) -> tuple[np.ndarray, np.ndarray]:
    """Return sign [rows] and index [rows] of the one-sided constraints: an equality gives two of them."""
    equal = np.flatnonzero(search.equality)
    count = search.equality.size
    return np.concatenate([np.ones(count), -np.ones(equal.size)]), np.concatenate([np.arange(count), equal])


def _lifted(evaluation: Evaluation, t: float, sign: np.ndarray, rows: np.ndarray) -> Evaluation:
    """Return the evaluation of the problem of the header, in the variables (y, t)."""
    if not evaluation.ok:
        return evaluation
    df = dc = None
    if evaluation.constraint_gradients is not None:
        df = np.append(np.zeros(evaluation.constraint_gradients.shape[1]), 1.0)
        dc = np.column_stack([sign[:, None] * evaluation.constraint_gradients[rows], -np.ones(rows.size)])
    return Evaluation(t, sign * evaluation.constraints[rows] - t, df, dc)
