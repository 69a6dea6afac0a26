"""Strictly convex quadratic program, dense and small, by the dual active-set method.

    minimize  c's + 1/2 s'B s   subject to   A s <= b,      B [n, n] positive definite

Starts at the unconstrained minimum and adds the most violated constraint until none is left. So it needs no feasible start,
its multipliers are exact, and it returns None for contradictory constraints.

Source: Goldfarb and Idnani, A numerically stable dual method for solving strictly convex quadratic programs,
Math. Programming 27 (1983) 1-33. The factors are recomputed at each change: n is the number of design variables.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, solve_triangular


@dataclass(frozen=True)
class QuadraticSolution:
    s: np.ndarray  # [n]
    multipliers: np.ndarray  # [m], >= 0


def solve_quadratic(B: np.ndarray, c: np.ndarray, A: np.ndarray, b: np.ndarray) -> QuadraticSolution | None:
    """Return minimizer and multipliers; None if no s satisfies A s <= b; LinAlgError if B is not positive definite."""
    L = np.linalg.cholesky(B)
    s = -cho_solve((L, True), c)
    normals = solve_triangular(L, A.T, lower=True).T  # rows of A in the metric of B
    length = np.sqrt((A * A).sum(axis=1))
    active: list[int] = []
    u = np.zeros(0)
    for _ in range(50 * (A.shape[0] + c.size) + 50):
        excess = A @ s - b
        tolerance = 1e-10 * (np.abs(b) + length * np.abs(s).max(initial=0.0)) + 1e-15 * length
        excess[active] = -np.inf
        worst = int(np.argmax(excess - tolerance)) if excess.size else 0
        if not excess.size or excess[worst] <= tolerance[worst]:
            multipliers = np.zeros(A.shape[0])
            multipliers[active] = u
            return QuadraticSolution(_refined(L, A[active], b[active], normals[active], s), multipliers)
        step = _enter(L, A, b, normals, s, active, u, worst)
        if step is None:
            return None
        s, u = step
    raise np.linalg.LinAlgError("the quadratic program cycles: its constraints are too badly scaled")


def _enter(
    L: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
    normals: np.ndarray,
    s: np.ndarray,
    active: list[int],
    u: np.ndarray,
    new: int,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Make constraint `new` active; `active` is changed in place: constraints whose multiplier becomes zero leave it."""
    gained = 0.0
    while True:
        N = normals[active].T
        d = np.linalg.lstsq(N, normals[new], rcond=None)[0] if active else np.zeros(0)
        free = normals[new] - N @ d
        square = free @ free
        independent = square > 1e-12 * (normals[new] @ normals[new])
        full = (A[new] @ s - b[new]) / square if independent else np.inf
        ratios = np.full(d.size, np.inf)
        ratios[d > 1e-14] = u[d > 1e-14] / d[d > 1e-14]
        leaving = int(np.argmin(ratios)) if d.size else -1
        partial = ratios[leaving] if d.size else np.inf
        step = min(full, partial)
        if not np.isfinite(step):
            return None
        u, gained = u - step * d, gained + step
        if independent:
            s = s - step * solve_triangular(L, free, lower=True, trans=1)
        if full <= partial:
            active.append(new)
            return s, np.maximum(np.append(u, gained), 0.0)
        active.pop(leaving)
        u = np.delete(u, leaving)


def _refined(L: np.ndarray, A: np.ndarray, b: np.ndarray, normals: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return s corrected to meet the active constraints to the last digit: with a small B it has lost digits."""
    for _ in range(2 if b.size else 0):
        w = np.linalg.lstsq(normals, b - A @ s, rcond=None)[0]
        s = s + solve_triangular(L, w, lower=True, trans=1)
    return s
