"""Problems of several criteria: what is asked of them.

    minimize f_1(x) .. f_k(x)   subject to   c_i(x) <= 0,   lower <= x <= upper

Such a problem is any object with `names`, `start`, `lower`, `upper` [n] as in optimizer.py, with `criteria` (a name each)
and `evaluate(X [lanes, n], gradients) -> list[Criteria]`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchmbd.optimization.optimizer import Box


@dataclass(frozen=True)
class Criteria:
    """Criteria and constraints of one design. A status but "ok" is the reason of a failure, the numbers nan."""

    values: np.ndarray  # [k]
    constraints: np.ndarray  # [m], satisfied where <= 0
    gradients: np.ndarray | None = None  # [k, n]
    constraint_gradients: np.ndarray | None = None  # [m, n]
    status: str = "ok"

    @property
    def ok(self) -> bool:
        return self.status == "ok"

    @property
    def differentiated(self) -> bool:
        """True if it comes with gradients."""
        return self.gradients is not None


class ManyCriteria(Box, Protocol):
    """A problem of several criteria (physical units everywhere)."""

    @property
    def criteria(self) -> Sequence[str]:
        """One name per criterion."""
        ...

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Criteria]:
        """Evaluate one design per row."""
        ...
