"""Batches of designs under evaluation: evaluated at once, or by workers while the caller goes on.

Checked in tests/optimization/multistart/test_batched.py, tests/optimization/multistart/test_workers.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sized
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from torchmbd.errors import InputError

T = TypeVar("T")  # Evaluation or Criteria


def wrong_count(evaluations: Sized, designs: Sized) -> InputError:
    """Build the error for a problem that does not return an evaluation for each design."""
    return InputError(
        ("problem", "evaluate"),
        allowed="must return one for each",
        state=f"returned {len(evaluations)} evaluations for {len(designs)} designs",
    )


class Batch(Protocol[T]):
    """Designs under evaluation."""

    @property
    def done(self) -> bool:
        """True if `evaluations` returns without waiting."""
        ...

    def notify(self, call: Callable[[], None]) -> None:
        """Have `call` called, from any thread, each time that `done` may have become true."""
        ...

    def evaluations(self) -> list[T]:
        """Wait for the evaluations, in the order of the designs; raise what evaluating has raised."""
        ...

    def cancel(self) -> None:
        """Stop the evaluation: nobody waits for it any more."""
        ...


@runtime_checkable
class ParallelEvaluator(Protocol):
    """A problem (optimizer.py) that evaluates several batches in parallel, such as on workers.

    Its number `parallel_batches` is how many it evaluates in about the time of one.
    """

    def begin(self, X: np.ndarray, gradients: bool, concurrent: int) -> Batch[Any]:
        """Begin to evaluate designs [lanes, n]; `concurrent` batches of this size share the workers."""
        ...


class CompletedBatch(Generic[T]):
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


def parallel_batches(problem: Any) -> int:
    """Return how many batches a problem evaluates in parallel."""
    return getattr(problem, "parallel_batches", 1)


def begin_batch(problem: Any, X: np.ndarray, gradients: bool, concurrent: int) -> Batch[Any]:
    """Begin to evaluate designs [lanes, n] in parallel if the problem can; else evaluate them now."""
    if isinstance(problem, ParallelEvaluator):
        return problem.begin(X, gradients, concurrent)
    return CompletedBatch(problem.evaluate(X, gradients))
