"""The metric in which a direction is short, and how it learns from the steps: the damped BFGS matrix of the Lagrangian.

    B <- B - (B s s'B) / (s'B s) + r r' / (s'r),     r = theta q + (1 - theta) B s,     q = dL(y + s) - dL(y)

theta keeps s'r >= 0.2 s'B s, so B stays positive definite where the Lagrangian is concave. A metric that was much too stiff
along the step is softened as a whole first (self-scaling): one long step must teach all directions.

Source: Powell, A fast algorithm for nonlinearly constrained optimization calculations, LNM 630 (1978) 144-157; Oren and
Luenberger, Self-scaling variable metric algorithms, Management Science 20 (1974) 845-862; Shanno and Phua, Math.
Programming 14 (1978) 149-160 (the first guess).
"""

from __future__ import annotations

import numpy as np

STIFF = 0.2  # s'q below this share of s'B s: the metric is too stiff
SOFTEN_AT_MOST = 0.01  # by this factor in one step
SOFTEST = 1e-11  # smallest eigenvalue kept, as a share of the first guess
CONDITION = 1e-10  # smallest eigenvalue kept, as a share of the largest
KNOWN_CONDITION = 1e-6  # the same where second derivatives are known, by differences
SOFT = 0.15  # a negative curvature counts as this share of it


class VariableMetric:
    """B [n, n], learnt from the gradients along the way."""

    def __init__(self, size: int) -> None:
        self.B = np.eye(size)
        self.fresh = True
        self.floor = 0.0

    @property
    def stretch(self) -> float:
        """How many times longer a step must be promised before it is tried: only the first is a guess."""
        return 1.5 if self.fresh else np.inf

    def reset(self, curvature: float) -> None:
        """Forget what was learnt; `curvature` sizes the next step."""
        self.B = np.eye(len(self.B)) * curvature
        self.floor = SOFTEST * curvature
        self.fresh = True

    def know(self, H: np.ndarray) -> None:
        """Take in the second derivatives H [n, n]; where they are negative the metric is soft: leave quickly."""
        values, vectors = np.linalg.eigh(H)
        values = np.where(values < 0.0, -SOFT * values, values)
        self.B = self.bounded((vectors * values) @ vectors.T, KNOWN_CONDITION)
        self.fresh = False

    def learn(self, s: np.ndarray, q: np.ndarray) -> None:
        """Take in a step s [n] over which the Lagrangian's gradient changed by q [n]."""
        B, sq = self.B, float(s @ q)
        if self.fresh and sq > SOFTEN_AT_MOST * float(s @ B @ s):
            B = np.eye(s.size) * (float(q @ q) / sq)
        Bs = B @ s
        sBs = float(s @ Bs)
        if not sBs > 0.0:
            return
        self.fresh = False
        if 0.0 < sq < STIFF * sBs:
            ratio = max(sq / sBs, SOFTEN_AT_MOST)
            B, Bs, sBs = B * ratio, Bs * ratio, sBs * ratio
        theta = 1.0 if sq >= 0.2 * sBs else 0.8 * sBs / (sBs - sq)
        r = theta * q + (1.0 - theta) * Bs
        B = B - np.outer(Bs, Bs) / sBs + np.outer(r, r) / (s @ r)
        self.B = self.bounded(B, CONDITION)

    def bounded(self, B: np.ndarray, condition: float) -> np.ndarray:
        """Return B with its eigenvalues raised to `condition` times the largest, and to the floor, where below."""
        values, vectors = np.linalg.eigh(0.5 * (B + B.T))
        least = max(condition * values[-1], self.floor)
        return B if values[0] >= least else (vectors * np.maximum(values, least)) @ vectors.T
