"""Kuhn-Tucker points that are not minima, by the second derivatives of the Lagrangian along active constraints.

A Kuhn-Tucker point is not a minimum if s'H s < 0 for a direction s along the constraints and bounds that have a multiplier:
a saddle point, or a maximum such as the ply angle of 90 degrees, where all gradients vanish by symmetry.
- No first-order method moves from a start that is one. So one more design is evaluated, near the start and inside the bounds:
  if it is better and feasible, the search begins there (`perturb_stationary_start`).
- First-order methods end in such points. So H is measured along these directions where a search has converged, by a design for
  each direction, all in one batch. If it has a negative eigenvalue, the search goes on from a design along its vector
  (`beyond_saddle`). The search for the least infeasible design does the same (least_infeasible.py).

Source: Nocedal and Wright, Numerical Optimization, section 12.5 (second-order conditions).
Checked in tests/optimization/test_curvature.py.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import null_space

from torchmbd.optimization.kkt import SMALLEST_OBJECTIVE, KuhnTucker
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

# Step, as a share of each variable's size: the gradients of a simulation carry a relative noise of 1e-6.
DIFFERENCE = 1e-3
MOST_DIRECTIONS = 20  # along which H is measured: each takes a simulation
GAIN = 1e-3  # of the objective, promised for a step of one along negative curvature: less is left
LENGTHS = 1.0, 0.25, 0.0625  # of steps away from a saddle point, in the scaled variables
REST = 1e-6  # of the objective: a fall of the merit function by less is rounding


def lagrangian_gradient(evaluation: Evaluation, multipliers: np.ndarray, weight: float = 1.0) -> np.ndarray:
    """Return the gradient of the Lagrangian [n]; weight: of the objective in it."""
    assert evaluation.objective_gradient is not None
    assert evaluation.constraint_gradients is not None
    return weight * evaluation.objective_gradient + evaluation.constraint_gradients.T @ multipliers


def carries(evaluation: Evaluation, quality: KuhnTucker, threshold: float) -> np.ndarray:
    """Return which constraints [m] have a multiplier above `threshold`, for constraints whose gradients have length one."""
    assert evaluation.constraint_gradients is not None
    return np.abs(quality.multipliers) * np.linalg.norm(evaluation.constraint_gradients, axis=1) > threshold


def tangent_basis(evaluation: Evaluation, quality: KuhnTucker, threshold: float, equality: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis [n, k] of the directions along equalities, and constraints and bounds with a multiplier.

    threshold  of multipliers, of constraints whose gradients have length one;  equality: which constraints [m] are equalities
    """
    assert evaluation.constraint_gradients is not None
    held = carries(evaluation, quality, threshold) | equality
    bounds = np.eye(quality.bound_multipliers.size)[np.abs(quality.bound_multipliers) > threshold]
    return null_space(np.vstack([evaluation.constraint_gradients[held], bounds]))


def reduced_hessian(
    search: Search,
    y: np.ndarray,
    evaluation: Evaluation,
    multipliers: np.ndarray,
    Z: np.ndarray,
    weight: float = 1.0,
) -> np.ndarray | None:
    """Return Z'H Z [k, k] by differences of gradients at k designs near y, in one batch; None if one of them fails.

    Z  directions [n, k];  H  second derivatives of the Lagrangian at y [n, n];  weight: of the objective in it
    """
    steps = []
    for z in Z.T:  # positive if y + step z lies inside the bounds, else negative
        step = DIFFERENCE / float((np.abs(z) / np.maximum(np.abs(y), 1.0)).max())
        inside = np.all((y + step * z >= search.lower) & (y + step * z <= search.upper))
        steps.append(step if inside else -step)
    neighbors = [np.clip(y + step * z, search.lower, search.upper) for step, z in zip(steps, Z.T, strict=True)]
    search.prefetch(neighbors)
    gradient = lagrangian_gradient(evaluation, multipliers, weight)
    rows = []
    for neighbor, step in zip(neighbors, steps, strict=True):
        near = search.evaluate(neighbor, gradients=True)
        if not near.ok:
            return None
        rows.append((lagrangian_gradient(near, multipliers, weight) - gradient) / step)
    reduced = np.array(rows).reshape(-1, y.size) @ Z
    return 0.5 * (reduced + reduced.T)


STATIONARY = 1e-6  # Kuhn-Tucker residual


def perturb_stationary_start(search: Search, first: Evaluation) -> tuple[np.ndarray, Evaluation]:
    """Return design [n] and evaluation to begin with: the start, unless it is stationary and a design near it is better."""
    y = search.start
    if search.kuhn_tucker(first, y).residual > STATIONARY:
        return y, first
    assert first.objective_gradient is not None
    perturbed = search.neighbor
    evaluation = search.evaluate(perturbed, gradients=True)
    better = evaluation.ok and evaluation.objective < first.objective - 1e-12 * max(1.0, abs(first.objective))
    if not better or search.violation(evaluation) > max(search.feasibility, search.violation(first)):
        return y, first
    search.record(perturbed)
    return perturbed, evaluation


def beyond_saddle(search: Search, y: np.ndarray, threshold: float) -> tuple[tuple[np.ndarray, Evaluation] | None, str]:
    """Return a design [n] beyond a Kuhn-Tucker point y that is a saddle point or a maximum, and its evaluation; else None.

    The Lagrangian is lower there, and constraints that the Lagrangian leaves out are not violated. The search goes on from
    there. The second result says why the curvature is not known, or is empty.

    threshold  multiplier from which a constraint or a bound is held
    """
    evaluation = search.evaluate(y, gradients=True)
    quality = search.kuhn_tucker(evaluation, y)
    size = max(abs(evaluation.objective), SMALLEST_OBJECTIVE)
    s, unknown = negative_curvature(search, y, quality, threshold, size)
    if s is None:
        return None, unknown
    weighed = carries(evaluation, quality, threshold)
    penalty = max(1.0, float(np.abs(quality.multipliers).max(initial=0.0)))

    def merit(there: Evaluation) -> float:
        """The Lagrangian of the constraints that carry a multiplier, with a penalty for the violation of all others."""
        c, others = there.constraints, there.constraints[~weighed]
        violated = np.where(search.equality[~weighed], np.abs(others), np.maximum(others, 0.0))
        return there.objective + float(quality.multipliers[weighed] @ c[weighed]) + penalty * float(violated.sum())

    return better_along(search, y, s, merit, REST * size), ""


def negative_curvature(
    search: Search, y: np.ndarray, quality: KuhnTucker, threshold: float, size: float, weight: float = 1.0
) -> tuple[np.ndarray | None, str]:
    """Return a direction [n] of negative curvature, its largest component one; None: there is none of account.

    It is the sum of all such directions, each towards the side with more room inside the bounds. The second result says why
    the curvature is not known, or is empty.

    size    of the function that is minimized: promised gains are compared with it
    weight  of the objective in the Lagrangian; 0 where the violation is minimized
    """
    evaluation = search.evaluate(y, gradients=True)
    held = carries(evaluation, quality, threshold) | search.equality
    free = y.size - int(held.sum()) - int((np.abs(quality.bound_multipliers) > threshold).sum())
    if free > MOST_DIRECTIONS:  # before a matrix of n x n numbers is made
        return None, f"the curvature was not measured in its {free} free directions, more than {MOST_DIRECTIONS}"
    Z = tangent_basis(evaluation, quality, threshold, search.equality)
    if not Z.shape[1]:
        return None, ""
    reduced = reduced_hessian(search, y, evaluation, quality.multipliers, Z, weight)
    if reduced is None:
        return None, "the curvature was not measured, because a design beside it fails"
    result = np.zeros(y.size)
    for value, vector in zip(*np.linalg.eigh(reduced), strict=True):
        s = Z @ vector
        s /= np.abs(s).max()
        if -0.5 * value * float(s @ s) > GAIN * size:
            result += s if _room(search, y, s) >= _room(search, y, -s) else -s
    largest = np.abs(result).max()
    return (result / largest, "") if largest > 0.0 else (None, "")


def better_along(
    search: Search, y: np.ndarray, s: np.ndarray, merit: Callable[[Evaluation], float], least: float
) -> tuple[np.ndarray, Evaluation] | None:
    """Return the first design along s, at +- LENGTHS, whose merit is lower by more than `least`; None: there is none."""
    limit = merit(search.evaluate(y)) - least
    for step in (sign * length * s for sign in (1.0, -1.0) for length in LENGTHS):
        trial = np.clip(y + step, search.lower, search.upper)
        there = search.evaluate(trial, gradients=True)
        if there.ok and merit(there) < limit:
            return trial, there
    return None


def _room(search: Search, y: np.ndarray, s: np.ndarray) -> float:
    """Return the largest t so that y + t s lies inside the bounds."""
    ahead = np.where(s > 0.0, search.upper - y, y - search.lower)
    return float(np.min(ahead[s != 0.0] / np.abs(s[s != 0.0]), initial=np.inf))
