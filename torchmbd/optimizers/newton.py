"""Newton's metric, for problems that simulate many designs in one batch at the price of a few.

    B = V |Lambda| V'   of   H = V Lambda V',        H from n neighbors (curvature.py)

Every trial is simulated together with its neighbors, so the Hessian of the Lagrangian is known where a step is accepted.
Directions of negative curvature get a soft metric of the opposite sign: a saddle point or a maximum repels, where a
quasi-Newton method lingers. The steps are limited by a reach that grows and shrinks.

Costs n + 1 analyses where the others need one, and about two thirds of the turns: worth it where a turn costs much the same
whatever the number of lanes (eager simulation of few starts, few variables). Where a neighbor fails, BFGS takes over.
Source: Dauphin et al., Identifying and attacking the saddle point problem, NIPS (2014): absolute eigenvalues.
"""

from __future__ import annotations

import numpy as np

from torchmbd.optimizers.curvature import hessian, neighbors
from torchmbd.optimizers.metric import VariableMetric
from torchmbd.optimizers.optimizer import Evaluation
from torchmbd.optimizers.search import Search


class NewtonMetric(VariableMetric):
    """B = |H| by differences of gradients."""

    first_reach, reach_if_short, reach_if_full = 0.5, 1.5, 2.0

    def companions(self, search: Search, y: np.ndarray) -> list[np.ndarray]:
        return neighbors(search, y)

    def look(self, search: Search, y: np.ndarray, here: Evaluation, multipliers: np.ndarray) -> bool:
        H = hessian(search, y, here, multipliers)
        if H is None:
            return False
        self.know(H)
        return True

    def reduced(
        self, search: Search, y: np.ndarray, here: Evaluation, multipliers: np.ndarray, Z: np.ndarray
    ) -> np.ndarray | None:
        H = hessian(search, y, here, multipliers)  # the neighbors are known
        return None if H is None else Z.T @ H @ Z
