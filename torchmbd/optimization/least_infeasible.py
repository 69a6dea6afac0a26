"""The least infeasible design, where no feasible one was found, and the constraints that conflict there.

    minimize t   subject to   c_i(y) <= t  (equalities: |c_i| <= t),   lower <= y <= upper

by steps d of a model in a trust region,

    minimize t + 1/2 d'B d   subject to   c_i + dc_i . d <= t,   lower <= y + d <= upper,   |d_k| <= radius

B approximates the second derivatives of the constraints, weighed by the multipliers (direction.py). The multipliers at the end
sum to one. No small change of the design reduces the violation of all constraints that have a multiplier: these conflict. The
search ends at the first design with t <= 0, which is feasible after all. From a design where the violation is stationary but
not a minimum, such as plies across a tube, it goes on along negative curvature (curvature.py).

A violation may have small waves, which come from the steps of a simulation. Gradients are then those of the waves, and the
search ends in one of them. So values alone are compared at its end, of designs y +- h e_k (compass search). The search moves to
the best of them and doubles h, or divides h by four where none is better, and goes on along gradients from its end.
Source: Madsen, Minimax solution of non-linear equations without calculating derivatives, Math. Programming Study 3 (1975)
110-126; Conn, Gould and Toint, Trust-region methods (2000), chapter 11; Kolda, Lewis and Torczon, SIAM Review 45
(2003) 385-482.
Checked in tests/optimization/test_least_infeasible.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.curvature import better_along, negative_curvature
from torchmbd.optimization.kkt import KuhnTucker, kuhn_tucker
from torchmbd.optimization.methods.direction import VariableMetric
from torchmbd.optimization.methods.quadratic import QuadraticSolution, solve_quadratic
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

ITERATIONS = 30
SADDLES = 3  # stationary designs that are not minima, which the search leaves
CONFLICT = 1e-2  # multiplier from which on a constraint counts as conflicting
FIRST_RADIUS, LEAST_RADIUS = 0.5, 1e-6  # of the scaled variables
REST = 1e-6  # promised fall of the violation, a share of it, at which the search has arrived
FIRST_CURVATURE = 1e-2  # of B, times the violation: a step of one in the scaled variables
FLAT = 1e-4  # curvature in t, over the violation: the quadratic program needs some
FIRST_LENGTH, LEAST_LENGTH, MOST_LENGTH = 0.25, 0.01, 1.0  # of the compass search, in the scaled variables
WAVES = 4  # compass searches that lead on
POLLS = 30  # batches of designs of a compass search at most
MOST_POLLED = 20  # variables of a compass search: two designs each
LOWER = 1e-3  # fall of the violation, a share of it, that counts as better in a compass search
GOOD, POOR = 0.75, 0.25  # shares of the promised fall from which the radius grows, below which it shrinks


@dataclass(frozen=True)
class LeastInfeasible:
    y: np.ndarray  # scaled
    violation: float  # largest violation of a constraint
    conflicting: list[int]  # indices of the constraints that conflict, ascending


def least_infeasible(search: Search, y: np.ndarray) -> LeastInfeasible:
    """Minimize the largest violation from `y` (scaled), a design that is evaluated already."""
    sign, rows = _rows(search)
    saddles = waves = 0
    while True:
        y, is_stationary = _descent(search, y, sign, rows)
        beside = _compass_search(search, y, FIRST_LENGTH if is_stationary else LEAST_LENGTH)
        if beside is not None and waves < WAVES:
            y, waves = beside, waves + 1
            continue
        evaluation = search.evaluate(y, gradients=True)
        violation = search.violation(evaluation)
        if violation <= search.feasibility:
            return LeastInfeasible(y, violation, [])
        quality = _quality(search, y, evaluation, sign, rows)
        beyond = None
        if saddles < SADDLES:
            s, _ = negative_curvature(search, y, quality, CONFLICT, violation, weight=0.0)
            beyond = None if s is None else better_along(search, y, s, search.violation, REST * violation)
        if beyond is None:
            conflicting = np.flatnonzero(np.abs(quality.multipliers) > CONFLICT).tolist()
            return LeastInfeasible(y, violation, conflicting)
        y, saddles = beyond[0], saddles + 1


def _descent(search: Search, y: np.ndarray, sign: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the design at which the steps of the header end, or the first one without a violation.

    The second value is True if the violation is stationary there: the model promises no less.
    """
    evaluation = search.evaluate(y, gradients=True)
    violation = search.violation(evaluation)
    metric, radius = VariableMetric(search.size), FIRST_RADIUS
    metric.reset(FIRST_CURVATURE * violation)
    for _ in range(ITERATIONS):
        if violation <= search.feasibility:
            return y, True
        c, dc = _one_sided(evaluation, sign, rows)
        model = _step(c, dc, metric.B, np.maximum(search.lower - y, -radius), np.minimum(search.upper - y, radius))
        if model is None:
            break
        d = np.clip(y + model.s[:-1], search.lower, search.upper) - y
        promised = violation - float((c + dc @ d).max())
        length = float(np.abs(d).max(initial=0.0))
        if promised <= REST * violation:
            return y, True
        if length <= LEAST_RADIUS:
            break
        trial = search.evaluate(y + d, gradients=True)
        share = (violation - search.violation(trial)) / promised if trial.ok else -np.inf
        if share < POOR:
            radius = 0.25 * length
        elif share >= GOOD and length >= 0.99 * radius:
            radius *= 2.0
        if trial.ok:
            multipliers = model.multipliers[: rows.size]
            metric.update(d, (_one_sided(trial, sign, rows)[1] - dc).T @ multipliers)
        if share > 0.0:
            y, evaluation, violation = y + d, trial, search.violation(trial)
    return y, violation <= search.feasibility


def _compass_search(search: Search, y: np.ndarray, least_length: float) -> np.ndarray | None:
    """Return a design that violates less than y and the designs beside it, or the first one without a violation.

    least_length  h at which the search ends
    The result is None if no design beside y violates less. If there are many variables, the search moves only those that change
    the violation most, by the gradients at y.
    """
    evaluation = search.evaluate(y, gradients=True)
    violation, length, better = search.violation(evaluation), FIRST_LENGTH, None
    assert evaluation.constraint_gradients is not None
    slopes = np.abs(evaluation.constraint_gradients[search.violated(evaluation)]).max(0, initial=0.0)
    axes = np.eye(search.size)[np.argsort(-slopes, kind="stable")[:MOST_POLLED]]
    for _ in range(POLLS):
        if violation <= search.feasibility or length < least_length:
            break
        beside = [np.clip(y + h * e, search.lower, search.upper) for e in axes for h in (length, -length)]
        beside = [z for z in beside if not np.array_equal(z, y)]
        search.prefetch(beside, gradients=search.eager_gradients)
        violations = [(search.violation(x), k) for k, x in enumerate(map(search.evaluate, beside)) if x.ok]
        least, k = min(violations, default=(np.inf, 0))
        if least < (1.0 - LOWER) * violation:
            y = better = beside[k]
            violation, length, least_length = least, min(2.0 * length, MOST_LENGTH), LEAST_LENGTH
        else:
            length *= 0.25
    return better


def _quality(search: Search, y: np.ndarray, evaluation: Evaluation, sign: np.ndarray, rows: np.ndarray) -> KuhnTucker:
    """Return multipliers of the constraints [m] and the bounds [n], and the residual, where the violation is minimized."""
    violation = search.violation(evaluation)
    lifted = _lifted(evaluation, violation, sign, rows)
    lower, upper = np.append(search.lower, -violation), np.append(search.upper, 2.0 * violation)
    quality = kuhn_tucker(lifted, np.append(y, violation), lower, upper, np.zeros(rows.size, dtype=bool))
    multipliers = np.zeros(search.equality.size)
    np.add.at(multipliers, rows, sign * quality.multipliers)
    return KuhnTucker(multipliers, quality.bound_multipliers[:-1], quality.residual)


def _step(
    c: np.ndarray, dc: np.ndarray, B: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> QuadraticSolution | None:
    """Return the step (d, t) of the model in the header, with the multipliers of the rows first; None: there is none."""
    violation, size = float(c.max()), c.size
    identity = np.eye(lower.size)
    metric = np.zeros((lower.size + 1, lower.size + 1))
    metric[:-1, :-1], metric[-1, -1] = B, FLAT / violation
    rows = np.block(
        [[dc, -np.ones((size, 1))], [identity, np.zeros((lower.size, 1))], [-identity, np.zeros((lower.size, 1))]]
    )
    return solve_quadratic(metric, np.append(np.zeros(lower.size), 1.0), rows, np.concatenate([-c, upper, -lower]))


def _rows(search: Search) -> tuple[np.ndarray, np.ndarray]:
    """Return sign [rows] and index [rows] of the one-sided constraints: an equality gives two of them."""
    equal = np.flatnonzero(search.equality)
    count = search.equality.size
    return np.concatenate([np.ones(count), -np.ones(equal.size)]), np.concatenate([np.arange(count), equal])


def _one_sided(evaluation: Evaluation, sign: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the one-sided constraints [rows] of an evaluation and their gradients [rows, n]."""
    assert evaluation.constraint_gradients is not None
    return sign * evaluation.constraints[rows], sign[:, None] * evaluation.constraint_gradients[rows]


def _lifted(evaluation: Evaluation, t: float, sign: np.ndarray, rows: np.ndarray) -> Evaluation:
    """Return the evaluation of the problem of the header, in the variables (y, t)."""
    c, dc = _one_sided(evaluation, sign, rows)
    return Evaluation(t, c - t, np.append(np.zeros(dc.shape[1]), 1.0), np.column_stack([dc, -np.ones(rows.size)]))
