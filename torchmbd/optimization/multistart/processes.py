"""Lanes x processes: a problem whose batches are shared out among processes, each with one torch thread.

    with mbd.Processes(problem, 2) as shared:
        study = mbd.multistart(shared, starts=mbd.sobol(32, seed=7))

Whatever asks for a batch of designs, a multistart or a grid, gets the same answers in a fraction of the time. Every
process keeps a copy of the problem. Processes of several machines, and studies that must survive: torchmbd/experiment.
Checked in tests/optimization/multistart/test_processes.py.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import tempfile
import threading
import warnings
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import torch

from torchmbd.errors import InputError
from torchmbd.optimization.optimizer import Evaluation, Problem, require_problem
from torchmbd.process import use_one_thread

_here: dict[str, Any] = {}  # in a worker: its copy of the problem, and where all workers meet


class Processes:
    """`problem` with batches evaluated by `count` processes (default: as many as there are cores).

    All else is asked of the problem itself, of which every process has a copy as it is now. Close it, or use it in a
    `with` block. If a process dies, the batch and all that follow are evaluated in the calling process, with a warning. A
    script that uses this keeps what it does under `if __name__ == "__main__":`, since every process imports it.
    """

    def __init__(self, problem: Problem, count: int | None = None):
        count = len(os.sched_getaffinity(0)) if count is None else count
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InputError(f"count of processes is {count!r}; allowed: a positive integer")
        require_problem(problem)
        self.problem, self.count = problem, count
        spawn = multiprocessing.get_context("spawn")  # a fork would copy threads' locks in whatever state they are
        # By a file: multiprocessing writes its arguments into a pipe, forever where the process has ended and they are many.
        self._folder = tempfile.TemporaryDirectory(prefix="torchmbd-")
        file = Path(self._folder.name) / "problem"
        file.write_bytes(_packed(problem))
        begin = (file, torch.get_default_dtype(), spawn.Barrier(count))
        self._pool: ProcessPoolExecutor | None = ProcessPoolExecutor(count, spawn, _begin, begin)
        self._begun = [self._pool.submit(_meet) for _ in range(count)]  # they start while the caller goes on

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "problem" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.problem, name)

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n], a share in each process."""
        parts = [part for part in np.array_split(np.asarray(X), self.count) if len(part)]
        if self._pool is not None and len(parts) > 1:
            try:
                shares = [cloudpickle.loads(x) for x in self._pool.map(_evaluate, parts, [gradients] * len(parts))]
                for share in shares:
                    if isinstance(share, Exception):
                        raise share
                return [found for share in shares for found in share]
            except BrokenProcessPool as error:
                self._go_on_alone(error)
        return self.problem.evaluate(X, gradients)

    def wait(self) -> None:
        """Wait until all processes are there."""
        try:
            for begun in self._begun:
                begun.result()
        except BrokenProcessPool as error:
            self._go_on_alone(error)

    def _go_on_alone(self, error: BrokenProcessPool) -> None:
        warnings.warn(
            f"a process that evaluates designs ended ({error}); the rest is evaluated in one process. Does the script "
            "keep what it does under `if __name__ == '__main__':`, and is there enough memory?",
            stacklevel=3,
        )
        self.close()

    def close(self) -> None:
        """End the processes; later batches are evaluated in the calling process."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(cancel_futures=True)
            self._folder.cleanup()

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None and self._pool is not None:  # Ctrl-C: nobody waits for what is under way
            for begun in self._begun:
                if begun.done() and not begun.exception():
                    os.kill(begun.result(), signal.SIGTERM)
        self.close()


def _packed(problem: Problem) -> bytes:
    try:
        return cloudpickle.dumps(problem)
    except Exception as error:  # of whatever the problem holds
        allowed = "one that can be pickled, with responses that hold no locks, files or threads"
        raise InputError(
            f"problem {problem!r} cannot be sent to other processes: {error}; allowed: {allowed}"
        ) from error


def _begin(file: Path, dtype: torch.dtype, barrier: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the caller's affair
    threading.Thread(target=_end_with_the_caller, daemon=True).start()
    use_one_thread()
    torch.set_default_dtype(dtype)
    own = cloudpickle.loads(file.read_bytes())
    _here.update({"problem": own, "all": barrier})
    with contextlib.suppress(Exception):  # it comes again, when the caller asks
        own.evaluate(np.asarray(own.start)[None], True)  # what is made once is made now


def _meet() -> int:
    """Wait until all processes are there; return which this is."""
    _here["all"].wait()
    return os.getpid()


def _evaluate(X: np.ndarray, gradients: bool) -> bytes:
    """Evaluations, or the error that the problem raised, whatever its class is made of."""
    try:
        return cloudpickle.dumps(_here["problem"].evaluate(X, gradients))
    except Exception as error:
        try:
            return cloudpickle.dumps(error)
        except Exception:  # it holds what cannot travel
            return cloudpickle.dumps(RuntimeError(f"{type(error).__name__}: {error}"))


def _end_with_the_caller() -> None:
    """A caller that is killed leaves nobody behind."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)
