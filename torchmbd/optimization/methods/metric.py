"""The metric of the direction-finding subproblem: the damped BFGS approximation of the Lagrangian's second derivatives.

    B <- B - (B s s'B) / (s'B s) + r r' / (s'r),     r = theta q + (1 - theta) B s,     q = dL(y + s) - dL(y)

theta keeps s'r >= 0.2 s'B s, so B stays positive definite where the Lagrangian is concave. Where B was much too large along
the step, all of B is scaled down first (self-scaling).

Source: Powell, A fast algorithm for nonlinearly constrained optimization calculations, LNM 630 (1978) 144-157; Oren and
Luenberger, Self-scaling variable metric algorithms, Management Science 20 (1974) 845-862; Shanno and Phua, Math.
Programming 14 (1978) 149-160 (the first guess).
"""

from __future__ import annotations

import numpy as np

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
