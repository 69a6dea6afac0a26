"""Where no feasible design was found: the least infeasible one, and the constraints that fight there.

    minimize t   subject to   c_i(y) <= t  (equalities: |c_i| <= t),   lower <= y <= upper

by feasible directions. At its Kuhn-Tucker point the multipliers are the shares of the constraints in the fight (they sum to
one): no small change of the design helps all of those with a share. An end with t <= 0 is a feasible design after all.
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
SHARE = 1e-2  # smaller shares are none


@dataclass(frozen=True)
class LeastInfeasible:
    y: np.ndarray  # scaled
    violation: float  # largest of a constraint
    fighting: list[int]  # constraints with a share, ascending


def least_infeasible(search: Search, y: np.ndarray) -> LeastInfeasible:
    """Minimize the largest violation from `y` (scaled), which is evaluated already."""
    sign, rows = _rows(search)

    def ask(X: np.ndarray, gradients: bool) -> list[Evaluation]:
        designs = [x[:-1] for x in X]
        search.prefetch(designs, gradients)
        return [_lifted(search.evaluate(d, gradients), x[-1], sign, rows) for d, x in zip(designs, X, strict=True)]

    t = search.violation(search.evaluate(y))
    start = np.append(y, t)
    lower, upper = np.append(search.lower, -t), np.append(search.upper, 2.0 * t)
    inner = Search(ask, start, lower, upper, feasibility=0.1 * search.feasibility)
    end = mmfd(inner, ITERATIONS).y
    found = search.evaluate(end[:-1], gradients=True)
    violation = search.violation(found)
    here = np.append(end[:-1], violation)
    quality = kuhn_tucker(_lifted(found, violation, sign, rows), here, lower, upper, np.zeros(rows.size, dtype=bool))
    fighting = sorted(set(rows[quality.multipliers > SHARE].tolist()))
    return LeastInfeasible(end[:-1], violation, fighting)


def _rows(search: Search) -> tuple[np.ndarray, np.ndarray]:
    """Return sign and index of the one-sided constraints: equalities count twice."""
    equal = np.flatnonzero(search.equality)
    count = search.equality.size
    return np.concatenate([np.ones(count), -np.ones(equal.size)]), np.concatenate([np.arange(count), equal])


def _lifted(evaluation: Evaluation, t: float, sign: np.ndarray, rows: np.ndarray) -> Evaluation:
    """Return the evaluation of the problem in (y, t)."""
    if not evaluation.ok:
        return evaluation
    df = dc = None
    if evaluation.constraint_gradients is not None:
        df = np.append(np.zeros(evaluation.constraint_gradients.shape[1]), 1.0)
        dc = np.column_stack([sign[:, None] * evaluation.constraint_gradients[rows], -np.ones(rows.size)])
    return Evaluation(t, sign * evaluation.constraints[rows] - t, df, dc)
