"""A problem that never forgets: no design is evaluated twice.

What is known lies in a store: in memory here, for designs to compare and to start from; on disk in
torchmbd/study/evaluations.py.
Checked in tests/optimization/test_cache.py, tests/study/test_evaluations.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from torchmbd.errors import InputError
from torchmbd.optimization.batch import Batch, Done, at_once, begin

T = TypeVar("T")  # Evaluation or Criteria


class Store(Protocol[T]):
    """Evaluations by design."""

    def find(self, X: np.ndarray, gradients: bool) -> list[T | None]:
        """Return what is known of designs [lanes, n]."""
        ...

    def keep(self, X: np.ndarray, gradients: bool, evaluations: Sequence[T]) -> None:
        """Add what was found of designs [lanes, n]."""
        ...


class Memory(Generic[T]):
    """A store in memory: `known` has design and answer by the bytes of the design."""

    def __init__(self) -> None:
        self.known: dict[bytes, tuple[np.ndarray, T]] = {}

    def find(self, X: np.ndarray, gradients: bool) -> list[T | None]:
        return [self.answer(x.tobytes(), gradients) for x in X]

    def keep(self, X: np.ndarray, gradients: bool, evaluations: Sequence[T]) -> None:
        self.known.update({x.tobytes(): (x, answer) for x, answer in zip(X, evaluations, strict=True)})

    def answer(self, key: bytes, gradients: bool) -> T | None:
        """Return what is known of a design, by its bytes; with gradients where these are asked for, and it has not failed."""
        answer: Any = self.known[key][1] if key in self.known else None
        return None if answer is None or (gradients and answer.ok and not answer.differentiated) else answer


class Remembered(Generic[T]):
    """`problem` with a memory, itself a problem; counts designs (`known`, `computed`) and batches of the computed.

    source    evaluates what is not known; None: the problem itself
    listener  hears of every batch, known or not
    """

    def __init__(
        self,
        problem: Any,
        store: Store[T],
        source: Any = None,
        listener: Callable[[np.ndarray, list[T]], None] = lambda X, evaluations: None,
    ) -> None:
        self.problem, self.store, self.source = problem, store, problem if source is None else source
        self.names, self.start, self.lower, self.upper = problem.names, problem.start, problem.lower, problem.upper
        self.known = self.computed = self.batches = 0
        self._listener = listener

    def __getattr__(self, name: str) -> Any:
        """Return what else the problem has: `equalities`, `period`, `motion`."""
        if name.startswith("__") or "problem" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.problem, name)

    @property
    def at_once(self) -> int:
        """How many batches are evaluated in parallel."""
        return at_once(self.source)

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[T]:
        """Evaluate designs [lanes, n], those not known in one batch."""
        return self.begin(X, gradients, 1).evaluations()

    def begin(self, X: np.ndarray, gradients: bool, among: int) -> Batch[T]:
        """Look designs [lanes, n] up, and begin to evaluate those that are not known, each once."""
        found = self.store.find(X, gradients)
        missing = {x.tobytes(): k for k, (x, known) in enumerate(zip(X, found, strict=True)) if known is None}
        rows = list(missing.values())
        self.computed += len(rows)
        self.known += len(X) - len(rows)
        self.batches += bool(rows)

        def complete(fresh: list[T]) -> list[T]:
            if len(fresh) != len(rows):
                raise InputError(f"problem.evaluate returned {len(fresh)} evaluations for {len(rows)} designs")
            if rows:
                self.store.keep(X[rows], gradients, fresh)
            new = dict(zip(missing, fresh, strict=True))
            evaluations = [new[x.tobytes()] if known is None else known for x, known in zip(X, found, strict=True)]
            self._listener(X, evaluations)
            return evaluations

        return _Completed(begin(self.source, X[rows], gradients, among) if rows else Done([]), complete)


class Cache(Remembered[T]):
    """`problem` with what is known in `memory`."""

    def __init__(self, problem: Any) -> None:
        self.memory = Memory[T]()
        super().__init__(problem, self.memory)


@dataclass
class _Completed(Generic[T]):
    """A batch whose unknown part is under way; kept, in the caller's thread, before it is returned."""

    unknown: Batch[T]
    complete: Callable[[list[T]], list[T]]

    @property
    def done(self) -> bool:
        return self.unknown.done

    def notify(self, call: Callable[[], None]) -> None:
        self.unknown.notify(call)

    def evaluations(self) -> list[T]:
        return self.complete(self.unknown.evaluations())

    def cancel(self) -> None:
        self.unknown.cancel()
