"""Second derivatives of the Lagrangian along some ways, and whether a Kuhn-Tucker point is a minimum.

A Kuhn-Tucker point is no minimum if s'H s < 0 for a direction s along the constraints and bounds that are pressed against
(those with a multiplier): a saddle point, or a maximum such as the ply angle of 90 degrees, where all gradients vanish by
symmetry.

Source: Nocedal and Wright, Numerical Optimization, section 12.5 (second-order conditions).
Checked in tests/optimization/test_curvature.py.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space

from torchmbd.optimization.kkt import KuhnTucker
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

# Step, as a share of each variable's size: the gradients of a simulation carry a relative noise of 1e-6.
DIFFERENCE = 1e-3


def slope(evaluation: Evaluation, multipliers: np.ndarray) -> np.ndarray:
    """Return the gradient of the Lagrangian [n]."""
    assert evaluation.objective_gradient is not None
    assert evaluation.constraint_gradients is not None
    return evaluation.objective_gradient + evaluation.constraint_gradients.T @ multipliers


def tangent(gradients: np.ndarray, quality: KuhnTucker, pressed: float) -> np.ndarray:
    """Return an orthonormal basis [n, k] of the ways along what has a multiplier above `pressed`."""
    bounds = np.eye(quality.bound_multipliers.size)[np.abs(quality.bound_multipliers) > pressed]
    return null_space(np.vstack([gradients[quality.multipliers > pressed], bounds]))


def along(search: Search, y: np.ndarray, here: Evaluation, multipliers: np.ndarray, Z: np.ndarray) -> np.ndarray | None:
    """Return Z'H Z [k, k] by k designs a little along the columns of Z in one batch; None if one of them fails."""
    steps = [_step(search, y, z) for z in Z.T]
    others = [np.clip(y + step * z, search.lower, search.upper) for step, z in zip(steps, Z.T, strict=True)]
    search.prefetch(others)
    rows = []
    for other, step in zip(others, steps, strict=True):
        there = search.evaluate(other, gradients=True)
        if not there.ok:
            return None
        rows.append((slope(there, multipliers) - slope(here, multipliers)) / step)
    reduced = np.array(rows).reshape(-1, y.size) @ Z
    return 0.5 * (reduced + reduced.T)


def _step(search: Search, y: np.ndarray, z: np.ndarray) -> float:
    """Return the length and sense of a small step along z that stays inside the bounds, if one does."""
    step = DIFFERENCE / float((np.abs(z) / np.maximum(np.abs(y), 1.0)).max())
    inside = np.all((y + step * z >= search.lower) & (y + step * z <= search.upper))
    return step if inside else -step
