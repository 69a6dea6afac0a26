"""A problem that never forgets: no design is evaluated twice, and all of them are there to compare and to start from."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numpy as np

from torchmbd.errors import InputError

T = TypeVar("T")  # Evaluation or Criteria


class Archive(Generic[T]):
    """`problem` with a memory, itself a problem; counts designs (`analyses`) and batches."""

    def __init__(self, problem: Any) -> None:
        self.problem = problem
        self.analyses = self.batches = 0
        self.known: dict[bytes, tuple[np.ndarray, T]] = {}  # design and answer by the bytes of x
        self.names, self.start, self.lower, self.upper = problem.names, problem.start, problem.lower, problem.upper

    def __getattr__(self, name: str) -> Any:
        """Return what else the problem has: `equalities`, `period`, `motion`."""
        return getattr(self.problem, name)

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[T]:
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
            self.known.update(zip(missing, zip(designs, answers, strict=True), strict=True))
        return [self.known[key][1] for key in keys]

    def _suffices(self, key: bytes, gradients: bool) -> bool:
        if key not in self.known:
            return False
        answer: Any = self.known[key][1]
        return not answer.ok or not gradients or answer.differentiated
