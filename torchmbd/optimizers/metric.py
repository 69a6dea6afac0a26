"""The metric in which a direction is short, and how it learns from the steps.

`VariableMetric`     the damped BFGS matrix of the Lagrangian:

    B <- B - (B s s'B) / (s'B s) + r r' / (s'r),     r = theta q + (1 - theta) B s,     q = dL(y + s) - dL(y)

    theta keeps s'r >= 0.2 s'B s, so B stays positive definite where the Lagrangian is concave. A metric that was much
    too stiff along the step is softened as a whole first (self-scaling): one long step must teach all directions.

`ConjugateMetric`    DOT's own: B = I, sized by the last step; the Fletcher-Reeves direction where nothing is active:

    s <- -df + (|df|^2 / |df_before|^2) s_before

Source: Powell, A fast algorithm for nonlinearly constrained optimization calculations, LNM 630 (1978) 144-157; Oren
and Luenberger, Self-scaling variable metric algorithms, Management Science 20 (1974) 845-862; Fletcher and Reeves,
Computer J. 7 (1964).
"""

from __future__ import annotations

import numpy as np

from torchmbd.optimizers.direction import Direction
from torchmbd.optimizers.optimizer import Evaluation

STIFF = 0.2  # s'q below this share of s'B s: the metric is too stiff
SOFTEN_AT_MOST = 0.01  # by this factor in one step
CONDITION = 1e-10  # smallest eigenvalue kept, as a share of the largest


class VariableMetric:
    """B [n, n] learns the curvature of the Lagrangian."""

    def __init__(self, size: int) -> None:
        self.B = np.eye(size)
        self.fresh = True

    @property
    def stretch(self) -> float:
        """How many times longer a step must be promised before it is tried: only the first is a guess."""
        return 1.5 if self.fresh else np.inf

    @property
    def refine(self) -> bool:
        """Whether a line search should go on although its step is acceptable."""
        return False

    def reset(self, curvature: float) -> None:
        """Forget what was learnt; `curvature` sizes the next step."""
        self.B = np.eye(len(self.B)) * curvature
        self.fresh = True

    def turn(self, direction: Direction, evaluation: Evaluation, free: bool) -> np.ndarray:
        """Return the direction to search along; `free`: nothing is active."""
        return direction.s

    def learn(self, s: np.ndarray, q: np.ndarray) -> None:
        """Take in a step s [n] over which the Lagrangian's gradient changed by q [n]."""
        B, sq = self.B, float(s @ q)
        if self.fresh and sq > SOFTEN_AT_MOST * float(s @ B @ s):
            # Shanno and Phua: the first guess is sized by the first curvature seen before it is updated.
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
        values, vectors = np.linalg.eigh(0.5 * (B + B.T))
        self.B = (vectors * np.maximum(values, CONDITION * values[-1])) @ vectors.T


class ConjugateMetric:
    """B = I / size; conjugate directions as long as nothing is active."""

    stretch = 1.2
    refine = True

    def __init__(self, size: int) -> None:
        self.B = np.eye(size)
        self.before: tuple[np.ndarray, np.ndarray] | None = None  # gradient and direction of the last free step
        self.turns = 0

    def reset(self, curvature: float) -> None:
        self.B = np.eye(len(self.B)) * curvature
        self.before, self.turns = None, 0

    def turn(self, direction: Direction, evaluation: Evaluation, free: bool) -> np.ndarray:
        df = evaluation.objective_gradient
        assert df is not None
        if not free:
            self.before, self.turns = None, 0
            return direction.s
        s = direction.s
        # A restart every n + 1 turns: beyond that the directions are no longer conjugate.
        if self.before is not None and self.turns <= df.size:
            df_before, s_before = self.before
            turned = -df + (df @ df) / (df_before @ df_before) * s_before
            if turned @ df < -0.1 * np.linalg.norm(turned) * np.linalg.norm(df):
                self.turns += 1
                self.before = df, turned
                return turned * (np.linalg.norm(s) / np.linalg.norm(turned))
        self.before, self.turns = (df, -df), 0
        return s

    def learn(self, s: np.ndarray, q: np.ndarray) -> None:
        """Size the next step by the curvature along this one."""
        curvature = float(s @ q) / float(s @ s) if s.any() else 0.0
        size = float(np.linalg.norm(q)) / float(np.linalg.norm(s)) if s.any() else 0.0
        if max(curvature, size) > 0.0:
            self.B = np.eye(s.size) * max(curvature, 0.1 * size)


Metric = VariableMetric | ConjugateMetric
METRICS: dict[str, type[VariableMetric] | type[ConjugateMetric]] = {
    "bfgs": VariableMetric,
    "conjugate": ConjugateMetric,
}
