"""Designs under evaluation: a batch that is done at once, or elsewhere while the caller does other things.

A problem that evaluates elsewhere has, beside what torchmbd.optimization.optimizer asks of every problem,

    at_once                         how many batches it evaluates side by side, in about the time of one
    begin(X, gradients, among)      a Batch of designs [lanes, n]; `among` batches of this size will be under way, so that
                                    it may take its share of the workers: number of workers / among

Checked in tests/optimization/multistart/test_batched.py, tests/optimization/multistart/test_workers.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from torchmbd.optimization.optimizer import Evaluation


class Batch(Protocol):
    """Designs under evaluation."""

    @property
    def done(self) -> bool:
        """Whether `evaluations` will not wait."""
        ...

    def notify(self, call: Callable[[], None]) -> None:
        """Call it, from whatever thread, each time that `done` may have become true."""
        ...

    def evaluations(self) -> list[Evaluation]:
        """Wait for the evaluations, in the order of the designs; raise what evaluating has raised."""
        ...

    def cancel(self) -> None:
        """Nobody waits for it any more."""
        ...


class Done:
    """A batch that was evaluated when it was begun."""

    done = True

    def __init__(self, evaluations: list[Evaluation]) -> None:
        self._evaluations = evaluations

    def notify(self, call: Callable[[], None]) -> None:
        call()

    def evaluations(self) -> list[Evaluation]:
        return self._evaluations

    def cancel(self) -> None:
        pass


def at_once(problem: Any) -> int:
    """Return how many batches a problem evaluates side by side."""
    return getattr(problem, "at_once", 1)


def begin(problem: Any, X: np.ndarray, gradients: bool, among: int) -> Batch:
    """Begin to evaluate designs [lanes, n]: here and now, or where the problem has it done."""
    if hasattr(problem, "begin"):
        return problem.begin(X, gradients, among)
    return Done(problem.evaluate(X, gradients))
