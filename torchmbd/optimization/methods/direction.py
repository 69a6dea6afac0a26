"""The direction-finding subproblem of the feasible directions method: usable (downhill) and feasible.

    minimize    df's + 1/2 s'B s                 no constraint violated, or the violated ones can be met at once
    minimize    df's + 1/2 s'B s - Phi beta      otherwise; beta <= 1, Phi raised as long as beta stays small
    subject to  dc_j's + beta c_j <= 0           j violated
                dc_j's + c_j <= 0                j active: no push-off, s may follow the constraint or meet it
                lower <= y + s <= upper          side constraints, exactly

Active are the constraints above CT, and those that the step would violate, to first order. The metric B replaces the ball
s's <= 1: with B = I the direction is the same.

Source: Vanderplaats, An efficient feasible directions algorithm for design synthesis, AIAA J. 22 (1984) 1633-1640,
and the description of method MMFD in the DOT user's manual, there with push-off factors theta_j and theta_j = 0 for
active constraints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.methods.quadratic import solve_quadratic
from torchmbd.optimization.optimizer import Evaluation

SUPPORT = 1e-8  # times Phi, added to the metric: beside a much larger Phi its digits would be lost
PHI = (1e2, 1e3, 1e4)  # in units of the objective


@dataclass(frozen=True)
class Direction:
    s: np.ndarray  # [n]
    multipliers: np.ndarray  # [m], >= 0, zero where not active
    beta: float  # share of the violation that s removes, to first order, 0 to 1


def find_direction(
    evaluation: Evaluation,
    y: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    B: np.ndarray,
    active: np.ndarray,
) -> Direction:
    """Return the direction from `y`; `active` [m] (bool): constraints in the first subproblem."""
    c, dc = evaluation.constraints, evaluation.constraint_gradients
    assert dc is not None
    held = active.copy()
    while True:
        direction = _solve(evaluation, y, lower, upper, B, np.flatnonzero(held))
        ahead = c + dc @ direction.s
        crossed = ~held & (ahead > 1e-9 * (1.0 + np.abs(c)))
        if not crossed.any():
            return direction
        held |= crossed


def _solve(
    evaluation: Evaluation, y: np.ndarray, lower: np.ndarray, upper: np.ndarray, B: np.ndarray, held: np.ndarray
) -> Direction:
    df, c, dc = evaluation.objective_gradient, evaluation.constraints, evaluation.constraint_gradients
    assert df is not None
    assert dc is not None
    bounded_above, bounded_below = np.flatnonzero(np.isfinite(upper)), np.flatnonzero(np.isfinite(lower))
    identity = np.eye(y.size)
    A = np.vstack([dc[held], identity[bounded_above], -identity[bounded_below]])
    b = np.concatenate([-c[held], (upper - y)[bounded_above], (y - lower)[bounded_below]])
    multipliers = np.zeros(c.size)
    exact = solve_quadratic(B, df, A, b)
    violated = np.maximum(c[held], 0.0)
    if exact is not None and exact.multipliers[: held.size] @ violated <= PHI[-1] * max(1.0, abs(evaluation.objective)):
        multipliers[held] = exact.multipliers[: held.size]
        return Direction(exact.s, multipliers, 1.0)
    return _relaxed(evaluation, B, A, b, held)


def _relaxed(evaluation: Evaluation, B: np.ndarray, A: np.ndarray, b: np.ndarray, held: np.ndarray) -> Direction:
    """Solve with beta = 1 - t as an additional unknown; Phi, its weight, is raised until t < 0.5."""
    df, c = evaluation.objective_gradient, evaluation.constraints
    assert df is not None
    size = df.size
    violated = np.zeros(A.shape[0])
    violated[: held.size] = np.maximum(c[held], 0.0)
    extended = np.block([[A, -violated[:, None]], [np.zeros((1, size)), -np.ones((1, 1))]])
    limits = np.append(b, 0.0)
    multipliers = np.zeros(c.size)
    for share in PHI:
        phi = share * max(1.0, abs(evaluation.objective))
        supported = B + SUPPORT * phi * np.eye(size)
        metric = np.block([[supported, np.zeros((size, 1))], [np.zeros((1, size)), np.full((1, 1), phi)]])
        solution = solve_quadratic(metric, np.append(df, 0.0), extended, limits)
        if solution is None:  # t = 1, s = 0 satisfies every row up to rounding
            return Direction(np.zeros(size), multipliers, 0.0)
        t = float(solution.s[-1])
        if t < 0.5:
            break
    multipliers[held] = solution.multipliers[: held.size]
    return Direction(solution.s[:-1], multipliers, 1.0 - t)
