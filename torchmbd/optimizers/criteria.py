"""Problems of several criteria: what is asked of them, and what was learnt about them on the way.

    minimize f_1(x) .. f_k(x)   subject to   c_i(x) <= 0,   lower <= x <= upper

Such a problem is any object with `names`, `start`, `lower`, `upper` [n] as in optimizer.py, with `criteria` (a name each)
and `evaluate(X [lanes, n], gradients) -> list[Criteria]`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchmbd.errors import InputError
from torchmbd.optimizers.optimizer import Box


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


class ManyCriteria(Box, Protocol):
    """A problem of several criteria (physical units everywhere)."""

    @property
    def criteria(self) -> Sequence[str]:
        """One name per criterion."""
        ...

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Criteria]:
        """Evaluate one design per row."""
        ...


class Archive:
    """A problem that never forgets: no design is evaluated twice, and all of them are there to start from."""

    def __init__(self, problem: ManyCriteria) -> None:
        self.problem = problem
        self.analyses = self.batches = 0
        self.known: dict[bytes, tuple[np.ndarray, Criteria]] = {}

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Criteria]:
        """Evaluate designs [lanes, n], those not known in one batch."""
        keys = [x.tobytes() for x in X]
        missing = {key: x for key, x in zip(keys, X, strict=True) if not self._suffices(key, gradients)}
        if missing:
            designs = np.stack(list(missing.values()))
            answers = self.problem.evaluate(designs, gradients)
            if len(answers) != len(designs):
                raise InputError(f"problem.evaluate returned {len(answers)} evaluations for {len(designs)} designs")
            self.batches += 1
            self.analyses += len(designs)
            for key, x, answer in zip(missing, designs, answers, strict=True):
                self.known[key] = x, self._checked(answer)
        return [self.known[key][1] for key in keys]

    def _suffices(self, key: bytes, gradients: bool) -> bool:
        if key not in self.known:
            return False
        seen = self.known[key][1]
        return not seen.ok or not gradients or seen.gradients is not None

    def _checked(self, answer: Criteria) -> Criteria:
        count = len(self.problem.criteria)
        if answer.ok and answer.values.shape != (count,):
            raise InputError(
                f"problem.evaluate returned criteria of shape {answer.values.shape}, allowed: {(count,)}, "
                f"{', '.join(self.problem.criteria)}"
            )
        return answer
