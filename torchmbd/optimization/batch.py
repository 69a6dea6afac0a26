"""Designs under evaluation: a batch that is done at once, or elsewhere while the caller does other things.

Checked in tests/optimization/multistart/test_batched.py, tests/optimization/multistart/test_workers.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

T = TypeVar("T")  # Evaluation or Criteria
T_co = TypeVar("T_co", covariant=True)


class Batch(Protocol[T_co]):
    """Designs under evaluation."""

    @property
    def done(self) -> bool:
        """Whether `evaluations` will not wait."""
        ...

    def notify(self, call: Callable[[], None]) -> None:
        """Call it, from whatever thread, each time that `done` may have become true."""
        ...

    def evaluations(self) -> list[T_co]:
        """Wait for the evaluations, in the order of the designs; raise what evaluating has raised."""
        ...

    def cancel(self) -> None:
        """It is not waited for any more."""
        ...


@runtime_checkable
class Elsewhere(Protocol):
    """What a problem has, beside what every problem has (optimizer.py), that evaluates elsewhere.

    Its number `at_once` is how many batches it evaluates in parallel, in about the time of one.
    """

    def begin(self, X: np.ndarray, gradients: bool, among: int) -> Batch[Any]:
        """Begin to evaluate designs [lanes, n]; `among` batches of this size will be under way, which share the workers."""
        ...


class Done(Generic[T]):
    """A batch that was evaluated when it was begun."""

    done = True

    def __init__(self, evaluations: list[T]) -> None:
        self._evaluations = evaluations

    def notify(self, call: Callable[[], None]) -> None:
        call()

    def evaluations(self) -> list[T]:
        return self._evaluations

    def cancel(self) -> None:
        pass


def at_once(problem: Any) -> int:
    """Return how many batches a problem evaluates in parallel."""
    return getattr(problem, "at_once", 1)


def begin(problem: Any, X: np.ndarray, gradients: bool, among: int) -> Batch[Any]:
    """Begin to evaluate designs [lanes, n]: here and now, or where the problem has it done."""
    if isinstance(problem, Elsewhere):
        return problem.begin(X, gradients, among)
    return Done(problem.evaluate(X, gradients))
