"""The direction-finding subproblem of the feasible directions method: usable (downhill) and feasible.

    minimize    df's + 1/2 s'B s                 no constraint violated, or the violated ones can be met at once
    minimize    df's + 1/2 s'B s - Phi beta      otherwise; beta <= 1, Phi raised as long as beta stays small
    subject to  dc_j's + beta c_j <= 0           j violated
                dc_j's + c_j <= 0                j active: no push-off, s may follow the constraint or meet it
                lower <= y + s <= upper          side constraints, exactly

Active are the constraints above CT, and those that the step would violate, to first order. The metric B replaces the ball
s's <= 1: with B = I the direction is the same.

B is the damped BFGS approximation of the Lagrangian's second derivatives:

    B <- B - (B s s'B) / (s'B s) + r r' / (s'r),     r = theta q + (1 - theta) B s,     q = dL(y + s) - dL(y)

theta keeps s'r >= 0.2 s'B s, so B stays positive definite where the Lagrangian is concave. Where B was much too large along
the step, all of B is scaled down first (self-scaling).

Source: Vanderplaats, An efficient feasible directions algorithm for design synthesis, AIAA J. 22 (1984) 1633-1640,
and the description of method MMFD in the DOT user's manual, there with push-off factors theta_j and theta_j = 0 for
active constraints. Of B: Powell, A fast algorithm for nonlinearly constrained optimization calculations, LNM 630 (1978)
144-157; Oren and Luenberger, Self-scaling variable metric algorithms, Management Science 20 (1974) 845-862; Shanno and Phua,
Math. Programming 14 (1978) 149-160 (the first guess).
Checked in tests/optimization/methods/test_direction.py.
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


SCALE_DOWN = 0.2  # s'q / (s'B s) below which B is scaled down
LEAST_SCALE = 0.01  # factor by which it is scaled in one step at least
LEAST_EIGENVALUE = 1e-11  # of B, as a share of the first guess
CONDITION = 1e-10  # least eigenvalue of B, as a share of the largest
HESSIAN_CONDITION = 1e-6  # the same where B comes from differences of gradients
NEGATIVE_CURVATURE = 0.15  # share of its size with which a negative curvature enters B


class VariableMetric:
    """B [n, n], updated by the gradients at the accepted designs."""

    def __init__(self, size: int) -> None:
        self.B = np.eye(size)
        self.fresh = True
        self.least_eigenvalue = 0.0

    @property
    def stretch(self) -> float:
        """The factor by which a model must lengthen a step before the longer one is tried; inf: only the first B is a guess."""
        return 1.5 if self.fresh else np.inf

    def reset(self, curvature: float) -> None:
        """Set B to `curvature` times the identity."""
        self.B = np.eye(len(self.B)) * curvature
        self.least_eigenvalue = LEAST_EIGENVALUE * curvature
        self.fresh = True

    def set_hessian(self, H: np.ndarray) -> None:
        """Set B to the second derivatives H [n, n], negative curvatures replaced by small positive ones: long steps there."""
        values, vectors = np.linalg.eigh(H)
        values = np.where(values < 0.0, -NEGATIVE_CURVATURE * values, values)
        self.B = self.bounded((vectors * values) @ vectors.T, HESSIAN_CONDITION)
        self.fresh = False

    def update(self, s: np.ndarray, q: np.ndarray) -> None:
        """Update B by a step s [n] over which the Lagrangian's gradient changed by q [n]."""
        B, sq = self.B, float(s @ q)
        if self.fresh and sq > LEAST_SCALE * float(s @ B @ s):
            B = np.eye(s.size) * (float(q @ q) / sq)
        Bs = B @ s
        sBs = float(s @ Bs)
        if not sBs > 0.0:
            return
        self.fresh = False
        if 0.0 < sq < SCALE_DOWN * sBs:
            ratio = max(sq / sBs, LEAST_SCALE)
            B, Bs, sBs = B * ratio, Bs * ratio, sBs * ratio
        theta = 1.0 if sq >= 0.2 * sBs else 0.8 * sBs / (sBs - sq)
        r = theta * q + (1.0 - theta) * Bs
        B = B - np.outer(Bs, Bs) / sBs + np.outer(r, r) / (s @ r)
        self.B = self.bounded(B, CONDITION)

    def bounded(self, B: np.ndarray, condition: float) -> np.ndarray:
        """Return B with smaller eigenvalues raised to `condition` times the largest and to `least_eigenvalue`."""
        values, vectors = np.linalg.eigh(0.5 * (B + B.T))
        least = max(condition * values[-1], self.least_eigenvalue)
        return B if values[0] >= least else (vectors * np.maximum(values, least)) @ vectors.T
