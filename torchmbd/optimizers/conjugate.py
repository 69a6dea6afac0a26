"""DOT's own metric: B = I, sized by the last step, and the Fletcher-Reeves direction where nothing is active.

    s <- -df + (|df|^2 / |df_before|^2) s_before,      restarted every n + 1 turns

Where constraints are active the direction is the steepest descent in their tangent plane. Converges linearly along curved
constraints: kept for comparison with the paper.
Source: Fletcher and Reeves, Function minimization by conjugate gradients, Computer J. 7 (1964) 149-154; DOT user's manual.
"""

from __future__ import annotations

import numpy as np

from torchmbd.optimizers.direction import Direction
from torchmbd.optimizers.metric import VariableMetric
from torchmbd.optimizers.optimizer import Evaluation

SMALLEST_CURVATURE = 0.1  # along a step, as a share of what the gradient changed in all


class ConjugateMetric(VariableMetric):
    """B = curvature times I; conjugate directions as long as nothing is active."""

    stretch = 1.2  # type: ignore[assignment]  # conjugacy needs accurate line searches
    refine = True

    def __init__(self, size: int) -> None:
        super().__init__(size)
        self.before: tuple[np.ndarray, np.ndarray] | None = None  # gradient and direction of the last free step
        self.turns = 0

    def reset(self, curvature: float) -> None:
        super().reset(curvature)
        self.before, self.turns = None, 0

    def turn(self, direction: Direction, evaluation: Evaluation, free: bool) -> np.ndarray:
        df, s = evaluation.objective_gradient, direction.s
        assert df is not None
        if not free:
            self.before, self.turns = None, 0
            return s
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
        length = float(np.linalg.norm(s))
        if length > 0.0:
            curvature = max(float(s @ q) / length**2, SMALLEST_CURVATURE * float(np.linalg.norm(q)) / length)
            if curvature > 0.0:
                self.B = np.eye(s.size) * curvature
