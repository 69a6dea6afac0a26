"""Multipliers and Kuhn-Tucker residual of a design, the same for every method.

    minimize over lambda >= 0, nu    | df + sum_i lambda_i dc_i + nu |
    residual = max_i ( |remainder_i| |y_i|, lambda_i |c_i|, |nu_i| gap_i ) / |f|

So the residual is the share of the objective that a change of a variable by its own size would gain, to first order.
For given lambda, nu takes what it can of each variable at a bound. So least squares run over the other variables, and those at
bounds whose remainder has the sign that nu cannot have; which of them these are follows in a few rounds.
The sums run over the constraints and bounds that are active, that is met but for a narrow band; the sign of an
equality's multiplier is free. |y_i| counts as 1 at least, |f| as a thousandth of its unit (units.py). Multipliers by
non-negative least squares, so they are estimates where the design is not optimal.
Source: Vanderplaats, Numerical Optimization Techniques for Engineering Design, section on the Kuhn-Tucker conditions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, nnls

from torchmbd.optimization.optimizer import Evaluation

# Constraints (as distances) and bounds (relative) so near may carry a multiplier. What they carry without being met
# counts as residual, so a wide band can only be better where a narrow one misses a constraint: the better of the two
# is taken.
BANDS = (1e-6, 1e-3)
SMALLEST_OBJECTIVE = 1e-3  # of its unit
MOST_ROUNDS = 50  # three are usual; any multipliers give a residual that is not too small


@dataclass(frozen=True)
class KuhnTucker:
    multipliers: np.ndarray  # [m]
    bound_multipliers: np.ndarray  # [n], positive at an upper, negative at a lower bound
    residual: float  # what could be gained, as a share of the objective: 0 at an optimum


def kuhn_tucker(
    evaluation: Evaluation,
    y: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    equality: np.ndarray,
    feasibility: float = 0.0,
) -> KuhnTucker:
    """Estimate the multipliers at `y`, whose evaluation carries gradients.

    feasibility           largest violation that counts as feasible
    """
    estimates = (_estimate(evaluation, y, lower, upper, equality, feasibility, band) for band in BANDS)
    return min(estimates, key=lambda estimate: estimate.residual)


def _estimate(
    evaluation: Evaluation,
    y: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    equality: np.ndarray,
    feasibility: float,
    band: float,
) -> KuhnTucker:
    df, dc, c = evaluation.objective_gradient, evaluation.constraint_gradients, evaluation.constraints
    assert df is not None
    assert dc is not None
    unit = np.maximum(1.0, np.sqrt((dc * dc).sum(axis=1)))
    active = np.flatnonzero((c >= -band * unit) | equality)
    both = active[equality[active]]
    near = band * np.maximum(1.0, np.abs(y))
    at_upper, at_lower = upper - y <= near, y - lower <= near
    columns = np.vstack([dc[active], -dc[both]]).T
    weights = _weights(columns, df, at_upper, at_lower)
    multipliers = np.zeros(c.size)
    multipliers[active] += weights[: active.size]
    multipliers[both] -= weights[active.size :]
    bounds, remainder = _split(df + columns @ weights, at_upper, at_lower)
    gaps = np.where(bounds > 0.0, upper - y, np.where(bounds < 0.0, y - lower, 0.0))
    size = max(abs(evaluation.objective), SMALLEST_OBJECTIVE)
    unmet = np.where((c <= feasibility) & ((c > 0.0) | equality & (c >= -feasibility)), 0.0, c)
    gains = np.concatenate([remainder * np.maximum(np.abs(y), 1.0), multipliers * unmet, bounds * gaps])
    return KuhnTucker(multipliers, bounds, float(np.abs(gains).max(initial=0.0)) / size)


def _split(r: np.ndarray, at_upper: np.ndarray, at_lower: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The multipliers of bounds that make r + nu least, and r + nu."""
    bounds = np.where(at_upper, np.maximum(-r, 0.0), 0.0) + np.where(at_lower, np.minimum(-r, 0.0), 0.0)
    return bounds, r + bounds


def _weights(columns: np.ndarray, df: np.ndarray, at_upper: np.ndarray, at_lower: np.ndarray) -> np.ndarray:
    """Multipliers >= 0 of constraints [k] that make df + columns @ weights + nu least, nu of the bounds.

    The square of this length is convex with a continuous slope, so steps to the minima of its parts, each shortened to the
    least length on its way, come to its minimum.
    """
    # Columns of length one: a constraint in other units must not lose its multiplier to a tolerance inside nnls.
    length = np.linalg.norm(columns, axis=0)
    length[length == 0.0] = 1.0
    unit, weights = columns / length, np.zeros(columns.shape[1])

    def remainder(x: np.ndarray) -> np.ndarray:
        return _split(df + unit @ x, at_upper, at_lower)[1]

    for _ in range(MOST_ROUNDS if weights.size else 0):
        counted = (remainder(weights) != 0.0) | ~(at_upper | at_lower)
        step = nnls(unit[counted], -df[counted])[0] - weights if counted.any() else 0.0 * weights
        along, share = unit @ step, 1.0
        if not along @ remainder(weights) < 0.0:
            break
        if along @ remainder(weights + step) > 0.0:  # beyond the least length
            share = brentq(lambda t: along @ remainder(weights + t * step), 0.0, 1.0)  # noqa: B023
        weights = np.maximum(weights + share * step, 0.0)
        if share == 1.0 and np.array_equal(counted, (remainder(weights) != 0.0) | ~(at_upper | at_lower)):
            break
    return weights / length
