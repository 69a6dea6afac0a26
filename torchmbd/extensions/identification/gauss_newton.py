"""How far a design of a fit is from the minimum: the step that linear residuals would still take.

    W J diag(s) = U S V'        derivatives in units of the unknowns' sizes s; W of the loss
    c = U' r                    the step in deviations: unknowns move by c_k / S_k of their sizes along V_k

|c| is independent of the units of data and unknowns. Beside the noise of the residuals, sigma n^1/2, it says by what part of
their deviations the n unknowns are off, for any number of data.

Two kinds of directions do not count: those along which derivatives are rounding, and those along which the unknowns change by
their whole size unseen in the noise. The latter do count where the residuals ask for more: a start that is far too small.
Unknowns at a bound do not count where the residuals drive them outward.
Source: Bates and Watts, A relative offset orthogonality convergence criterion for nonlinear least squares, Technometrics 23
(1981) 179-183. Robust losses: Triggs et al., Bundle adjustment (2000).
Checked in tests/extensions/identification/test_least_squares.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.extensions.identification.losses import Loss, of_rows
from torchmbd.extensions.identification.unseen import NOISE, ROUNDING

AT_BOUND = 1e-6  # of its unit: an unknown that is as near to a bound
_ASKED = 3.0  # deviations of the noise along a direction, beyond which the residuals ask for a step


@dataclass(frozen=True)
class RemainingStep:
    """The step to the minimum of linear residuals.

    deviations  its length, beside the deviations of the unknowns
    sizes       largest change of an unknown, beside its size
    """

    deviations: float
    sizes: float


def remaining_step(
    values: np.ndarray,
    jacobian: np.ndarray,
    x: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    scale: np.ndarray,
    loss: Loss,
    f_scale: float,
    data: int,
) -> RemainingStep:
    """The step of residuals [N] with derivatives [N, n] at unknowns [n]; the loss is that of the first `data` rows."""
    rho = of_rows(loss, data)((values / f_scale) ** 2)
    curvature = np.maximum(rho[1] + 2.0 * rho[2] * (values / f_scale) ** 2, np.finfo(float).eps)
    weight = np.sqrt(curvature)
    r, gradient = rho[1] * values / weight, jacobian.T @ (rho[1] * values)
    size = np.maximum(scale, np.abs(x))
    near = AT_BOUND * size
    outward = ((x - lower < near) & (gradient > 0.0)) | ((upper - x < near) & (gradient < 0.0))
    moves = (lower < upper) & ~outward & (np.abs(jacobian).max(0, initial=0.0) > 0.0)
    count = int(moves.sum())
    if not count:
        return RemainingStep(0.0, 0.0)
    U, S, rows = np.linalg.svd(weight[:, None] * jacobian[:, moves] * size[moves], full_matrices=False)
    c = U.T @ r
    sigma = np.sqrt(float(rho[1] @ values**2) / max(len(values) - count, 1))
    noise = min(sigma, 1.0)
    counts = (ROUNDING * S[0] <= S) & ~((NOISE * noise > S) & (np.abs(c) <= _ASKED * noise))
    if not counts.any():
        return RemainingStep(0.0, 0.0)
    length = float(np.linalg.norm(c[counts]))
    change = float(np.abs(rows[counts].T @ (c[counts] / S[counts])).max())
    return RemainingStep(length / (sigma * np.sqrt(count)) if sigma > 0.0 else 0.0, change)
