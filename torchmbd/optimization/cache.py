"""A problem whose evaluations are stored: no design is evaluated twice.

A store is in memory (MemoryStore), or on disk (torchmbd/study/record/evaluations.py).
Checked in tests/optimization/test_cache.py, tests/study/record/test_evaluations.py.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from torchmbd.optimization.batch import Batch, CompletedBatch, begin_batch, parallel_batches, wrong_count

T = TypeVar("T")  # Evaluation or Criteria


class Store(Protocol[T]):
    """Evaluations by design."""

    def find(self, X: np.ndarray, gradients: bool) -> list[T | None]:
        """Return the evaluation of each design [lanes, n], None where it is not stored."""
        ...

    def keep(self, X: np.ndarray, gradients: bool, evaluations: Sequence[T]) -> None:
        """Store the evaluations of designs [lanes, n]."""
        ...


class MemoryStore(Generic[T]):
    """A store in memory: `entries` holds each design with its evaluation, by the bytes of the design."""

    def __init__(self) -> None:
        self.entries: dict[bytes, tuple[np.ndarray, T]] = {}

    def find(self, X: np.ndarray, gradients: bool) -> list[T | None]:
        return [self.lookup(x.tobytes(), gradients) for x in X]

    def keep(self, X: np.ndarray, gradients: bool, evaluations: Sequence[T]) -> None:
        self.entries.update({x.tobytes(): (x, evaluation) for x, evaluation in zip(X, evaluations, strict=True)})

    def lookup(self, key: bytes, gradients: bool) -> T | None:
        """Return the evaluation of a design (its bytes); None if it lacks the gradients that are required.

        A failed evaluation has none, and serves all the same.
        """
        evaluation: Any = self.entries[key][1] if key in self.entries else None
        if evaluation is not None and gradients and evaluation.ok and not evaluation.differentiated:
            return None
        return evaluation


class CachedProblem(Generic[T]):
    """`problem` with a store of evaluations, itself a problem.

    evaluator  evaluates designs that are not in the store; None: the problem itself
    listener   called with the designs and evaluations of every batch, stored or new
    begun      called with the number of a batch and how many designs it evaluates, before it does
    others     store and evaluator of a problem of other accuracy (finer_motions.py); None: the problem is not refined

    Counts the designs that were found (`hits`) and evaluated (`computed`), and the batches of the latter, of all accuracies.
    """

    def __init__(
        self,
        problem: Any,
        store: Store[T],
        evaluator: Any = None,
        listener: Callable[[np.ndarray, list[T]], None] = lambda X, evaluations: None,
        begun: Callable[[int, int], None] = lambda number, designs: None,
        others: Callable[[Any], tuple[Store[T], Any]] | None = None,
    ) -> None:
        self.problem, self.store, self.evaluator = problem, store, problem if evaluator is None else evaluator
        self.names, self.start, self.lower, self.upper = problem.names, problem.start, problem.lower, problem.upper
        self.counts = Counter[str]()
        self._listener, self._begun, self._others = listener, begun, others

    @property
    def hits(self) -> int:
        """Number of designs that were in the store."""
        return self.counts["hits"]

    @property
    def computed(self) -> int:
        """Number of designs that were evaluated."""
        return self.counts["computed"]

    @property
    def batches(self) -> int:
        """Number of batches that were evaluated."""
        return self.counts["batches"]

    @property
    def coarse(self) -> CachedProblem[T] | None:
        """The problem of less accuracy for the way to an optimum, with its own store; None: there is none."""
        return None if self._others is None else self._with(getattr(self.problem, "coarse", None))

    def refined(self, x: np.ndarray) -> CachedProblem[T] | None:
        """The problem of the accuracy that a design [n] needs, with its own store; None: it has it."""
        if self._others is None or not hasattr(type(self.problem), "refined"):
            return None
        return self._with(self.problem.refined(x))

    def _with(self, problem: Any) -> CachedProblem[T] | None:
        if problem is None or self._others is None:
            return None
        other = CachedProblem(problem, *self._others(problem), self._listener, self._begun, self._others)
        other.counts = self.counts
        return other

    def __getattr__(self, name: str) -> Any:
        """Return what else the problem has: `equalities`, `period`, `motion`."""
        if name.startswith("__") or "problem" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.problem, name)

    @property
    def parallel_batches(self) -> int:
        return parallel_batches(self.evaluator)

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[T]:
        """Evaluate designs [lanes, n], those not in the store in one batch."""
        return self.begin(X, gradients, 1).evaluations()

    def begin(self, X: np.ndarray, gradients: bool, concurrent: int) -> Batch[T]:
        """Look designs [lanes, n] up, and begin to evaluate those that are not in the store, each once."""
        entries = self.store.find(X, gradients)
        missing = {x.tobytes(): k for k, (x, known) in enumerate(zip(X, entries, strict=True)) if known is None}
        rows = list(missing.values())
        self.counts.update(computed=len(rows), hits=len(X) - len(rows), batches=bool(rows))
        if rows:
            self._begun(self.counts["batches"], len(rows))

        def complete(computed: list[T]) -> list[T]:
            if len(computed) != len(rows):
                raise wrong_count(computed, rows)
            if rows:
                self.store.keep(X[rows], gradients, computed)
            new = dict(zip(missing, computed, strict=True))
            evaluations = [new[x.tobytes()] if known is None else known for x, known in zip(X, entries, strict=True)]
            self._listener(X, evaluations)
            return evaluations

        batch = begin_batch(self.evaluator, X[rows], gradients, concurrent) if rows else CompletedBatch([])
        return _PartlyStored(batch, complete)


class MemoryCachedProblem(CachedProblem[T]):
    """`problem` with a store in `memory`."""

    def __init__(self, problem: Any) -> None:
        self.memory = MemoryStore[T]()
        super().__init__(problem, self.memory)


@dataclass
class _PartlyStored(Generic[T]):
    """A batch of which a part is being evaluated; `complete`, called in the caller's thread, stores this and adds the rest."""

    computed: Batch[T]
    complete: Callable[[list[T]], list[T]]

    @property
    def done(self) -> bool:
        return self.computed.done

    def notify(self, call: Callable[[], None]) -> None:
        self.computed.notify(call)

    def evaluations(self) -> list[T]:
        return self.complete(self.computed.evaluations())

    def cancel(self) -> None:
        self.computed.cancel()
