"""Multipliers and Kuhn-Tucker residual of a design, the same for every method.

    minimize over lambda >= 0, nu    | df + sum_i lambda_i dc_i + nu |
    residual = max_i ( |remainder_i| |y_i|, lambda_i |c_i|, |nu_i| gap_i ) / |f|

So the residual is the share of the objective that a change of a variable by its own size would gain, to first order.
The sums run over the constraints and bounds that are active, that is met but for a narrow band; the sign of an
equality's multiplier is free. |y_i| counts as 1 at least, |f| as a thousandth of its unit (units.py). Multipliers by
non-negative least squares, so they are estimates where the design is not optimal.
Source: Vanderplaats, Numerical Optimization Techniques for Engineering Design, section on the Kuhn-Tucker conditions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from torchmbd.optimization.optimizer import Evaluation

# Constraints (as distances) and bounds (relative) so near may carry a multiplier. What they carry without being met
# counts as residual, so a wide band can only be better where a narrow one misses a constraint: the better of the two
# is taken.
BANDS = (1e-6, 1e-3)
SMALLEST_OBJECTIVE = 1e-3  # of its unit


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

    feasibility  violation of a constraint that counts as none
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
    at_upper, at_lower = np.flatnonzero(upper - y <= near), np.flatnonzero(y - lower <= near)
    identity = np.eye(y.size)
    columns = np.vstack([dc[active], -dc[both], identity[at_upper], -identity[at_lower]]).T
    multipliers, bounds, remainder = np.zeros(c.size), np.zeros(y.size), df
    if columns.shape[1]:
        # Columns of length one: a constraint in other units must not lose its multiplier to a tolerance inside nnls.
        length = np.linalg.norm(columns, axis=0)
        length[length == 0.0] = 1.0
        weights = nnls(columns / length, -df)[0] / length
        parts = np.split(weights, np.cumsum([active.size, both.size, at_upper.size]))
        multipliers[active] += parts[0]
        multipliers[both] -= parts[1]
        bounds[at_upper] += parts[2]
        bounds[at_lower] -= parts[3]
        remainder = df + columns @ weights
    gaps = np.where(bounds > 0.0, upper - y, np.where(bounds < 0.0, y - lower, 0.0))
    size = max(abs(evaluation.objective), SMALLEST_OBJECTIVE)
    unmet = np.where((c <= feasibility) & ((c > 0.0) | equality & (c >= -feasibility)), 0.0, c)
    gains = np.concatenate([remainder * np.maximum(np.abs(y), 1.0), multipliers * unmet, bounds * gaps])
    return KuhnTucker(multipliers, bounds, float(np.abs(gains).max(initial=0.0)) / size)
