"""Copies of a problem for threads. A motion replaces parameters of modules in place, so that every thread needs its modules.

    group   designs of a batch that one thread evaluates, from the structure stage to the gradients of the responses

Groups follow from the number of designs alone, and all run on the same code, so that evaluations have the same bits with any
number of threads. A group has at least LEAST designs, since each costs the calls of Python of one design, which exclude those
of other threads.

Copies share tensors and arrays with the problem and are made anew where it has others. A problem with a class or function of
a user, such as a law or a response, has no copies, as these need not be written for threads: one thread evaluates its groups
one after the other.
Checked in tests/design/test_thread_copies.py.
"""

from __future__ import annotations

import io
import itertools
import pickle
import sys
import threading
from collections.abc import Callable
from contextlib import nullcontext
from contextvars import Context, copy_context
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import warn, warnings_held
from torchmbd.math.module_call import apart, exclusive
from torchmbd.math.threads import map_threads
from torchmbd.process import thread_count
from torchmbd.progress import without_bars

#: Packages whose objects serve in several threads.
SOURCES = {*sys.stdlib_module_names, "torchmbd", "torch", "numpy", "scipy"}
LEAST = 32  # designs of a group: the calls of Python take 5 % of its time
Problem = TypeVar("Problem")
Result = TypeVar("Result")


class ForeignObject(Exception):
    """A class or function of a user, which may not run in several threads."""


class _Copies(NamedTuple):
    """Copies of a problem as it was.

    state    the problem without its tensors and arrays, pickled
    shared   its tensors and arrays
    """

    state: bytes
    shared: list[Any]
    copies: list[Any]


_known: WeakKeyDictionary[Any, _Copies] = WeakKeyDictionary()  # of each problem that was evaluated in groups


class _Pickler(pickle.Pickler):
    """Writes an object without its tensors and arrays, which it lists."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.shared: list[Any] = []

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, (Tensor, np.ndarray)):
            return None
        self.shared.append(obj)
        return len(self.shared) - 1


class _Unpickler(pickle.Unpickler):
    """Reads what `_Pickler` has written, with the same tensors and arrays."""

    def __init__(self, state: bytes, shared: list[Any]) -> None:
        super().__init__(io.BytesIO(state))
        self.shared = shared

    def persistent_load(self, pid: int) -> Any:
        return self.shared[pid]

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] not in SOURCES:
            raise ForeignObject(f"{module}.{name}")
        return super().find_class(module, name)


def _written(x: Any) -> tuple[bytes, list[Any]]:
    """Return an object without its tensors and arrays, pickled, and these."""
    file = io.BytesIO()
    pickler = _Pickler(file)
    pickler.dump(x)
    return file.getvalue(), pickler.shared


def _are_same(before: list[Any], shared: list[Any]) -> bool:
    """Return True where tensors and arrays are those of before, or constants in the same memory: a motion, at whose end others
    start, is written with new ones each time."""
    return len(before) == len(shared) and all(map(_is_same, before, shared))


def _is_same(x: Any, y: Any) -> bool:
    if x is y:
        return True
    if not (type(x) is type(y) is Tensor) or x.requires_grad or y.requires_grad:
        return False
    layouts = [(z.layout, z.dtype, z.shape) for z in (x, y)]
    if layouts[0] != layouts[1] or x.layout is not torch.strided:
        return False
    return x.data_ptr() == y.data_ptr() and x.stride() == y.stride()


def design_groups(X: np.ndarray) -> list[np.ndarray]:
    """Return the groups of designs [lanes, n], of nearly equal size."""
    return np.array_split(X, max(1, len(X) // LEAST))


def in_groups(problem: Problem, evaluate: Callable[[Problem, np.ndarray], list[Result]], X: np.ndarray) -> list[Result]:
    """Return evaluate(problem, X) for designs [lanes, n], whose groups are shared among the threads of this process."""
    groups = design_groups(X)
    return evaluate(problem, X) if len(groups) == 1 else _shared(problem, evaluate, groups)


@exclusive
def _shared(
    problem: Problem, evaluate: Callable[[Problem, np.ndarray], list[Result]], groups: list[np.ndarray]
) -> list[Result]:
    copies = _copies_of(problem, min(thread_count(), len(groups)) - 1, lambda copy: evaluate(copy, groups[0][:1]))
    idle, caller = list(copies), threading.get_ident()
    warned: list[list[Any]] = [[] for _ in groups]

    def evaluated(of: Problem, number: int) -> list[Result]:
        with warnings_held() as warned[number]:
            return evaluate(of, groups[number])

    def run(number: int, context: Context) -> list[Result]:
        if threading.get_ident() == caller:
            return evaluated(problem, number)
        copy = idle.pop()  # there is one for each other thread
        try:
            with apart():
                return context.run(evaluated, copy, number)
        finally:
            idle.append(copy)

    try:
        with without_bars() if copies else nullcontext():
            contexts = [copy_context() for _ in groups]
            parts = map_threads(run, range(len(groups)), contexts, threads=1 + len(copies))
    except BaseException:
        _known.pop(problem, None)  # Ctrl-C while the others are waited for leaves threads that still use their copies
        raise
    finally:
        for text, category in itertools.chain.from_iterable(warned):
            warn(text, category)
    return [result for part in parts for result in part]


def _copies_of(problem: Any, count: int, begin: Callable[[Any], object]) -> list[Any]:
    """Return `count` copies; none for the first batch, where the problem compiles, chooses steps and looks at its start.

    begin   is called with every new copy by the calling thread: a first motion compiles and keeps what later ones use
    """
    if count < 1:
        return []
    try:
        state, shared = _written(problem)
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, RuntimeError):  # by the kind of object
        return []
    known = _known.get(problem)
    if known is None:
        _known[problem] = _Copies(b"", [], [])
        return []
    if known.state != state or not _are_same(known.shared, shared):
        known = _known[problem] = _Copies(state, shared, [])
    while len(known.copies) < count:
        try:
            copy = _Unpickler(state, shared).load()
        except ForeignObject:
            return []
        with warnings_held():  # the problem has warned
            begin(copy)
        known.copies.append(copy)
    return known.copies[:count]
