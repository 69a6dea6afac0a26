"""Evaluation by Dask workers: processes of this machine, workers of any scheduler by its address, or jobs of a cluster.

    with mbd.optimization.Processes(problem, 2) as shared:
        study = mbd.optimization.multistart(shared, starts=mbd.optimization.sobol(32, seed=7))

The starts of a study are in at least as many groups as there are workers (batched.py); each group has a batch of up to LANES
designs under evaluation, so that no worker waits for another. With fewer batches than workers each is divided into pieces.
A worker makes the problem once, and evaluates a piece as one batch. The piece of a worker that dies is evaluated by another,
with the same numbers: a piece depends on its designs alone. Designs that are evaluated together change gradients in the
seventh digit (an iteration ends for all designs of a batch at once), so studies agree to the last digit if they have the same
number of workers, whichever dies.
Half a batch takes more than half the time of a batch (a step takes the same operations): workers pay with many starts.

One thread each, unless TORCHMBD_THREADS gives compiled code more: a worker must be started with OMP_NUM_THREADS=1 (the local
cluster and jobs of SLURM are).
Messages of Dask are pickled: connect only to schedulers that you trust. The local cluster accepts its own process alone
(local_cluster.py).
Checked in tests/optimization/multistart/test_workers.py, tests/study/test_dask_evaluator.py, tests/study/test_cluster.py.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Self

import cloudpickle
import numpy as np
import torch

from torchmbd.errors import InputError, MbdError, not_installed
from torchmbd.optimization.optimizer import Evaluation, NonlinearProgram, require_problem
from torchmbd.process import THREADS, brief_warnings, cores, use_one_thread, worker_threads

LANES = 64  # designs in one batch of one process: more gain little, and cost memory
_MAX_DEATHS = 3  # of workers that evaluate the same piece, until its designs count as failed
_SETTINGS: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": _MAX_DEATHS,
    "distributed.deploy.lost-worker-timeout": "1h",  # one that dies is started again: on a busy machine not within 15 s
    "distributed.worker.multiprocessing-method": "forkserver",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",  # 20 ms by itself: a wake-up that interrupts the numbers
}
_SILENCED_LOGGERS = ("distributed", "distributed.client", "tornado.application")
_TIMEOUT = 60  # seconds to wait for a scheduler, and for workers without a queue


class Workers:
    """A context manager that evaluates designs of one problem on workers.

    make, arguments  function that makes the problem on a worker, and its arguments (hashable)
    problem          the problem in this process, whose steps the workers take; None: each of them chooses
    rows             number of constraints of the problem
    workers          number of workers on this machine or of `start`; 0: one for each core of this process
    scheduler        address of a scheduler whose workers evaluate; None: processes of this machine
    start            function that starts a cluster of so many workers, which may have to queue
    """

    def __init__(
        self,
        make: Callable[..., NonlinearProgram],
        arguments: tuple[Any, ...],
        rows: int = 0,
        workers: int = 0,
        scheduler: str | None = None,
        start: Callable[[int], Any] | None = None,
        problem: Any = None,
    ) -> None:
        self._made, self.problem = (make, arguments), problem
        self.rows, self.scheduler = rows, scheduler
        self._workers, self._start = workers or cores(), start
        self._client: Any = None
        self._cluster: Any = None
        self._left = contextlib.ExitStack()  # what makes this process as it was before

    def __enter__(self) -> Self:
        try:
            from dask import config  # pyright: ignore[reportMissingImports]
            from distributed import Client  # pyright: ignore[reportMissingImports]

            from torchmbd.optimization.multistart.local_cluster import start_local_cluster
        except ModuleNotFoundError as error:
            raise not_installed(
                "workers",
                self._workers,
                "the client of workers",
                str(error.name),
                "pip install 'torchmbd[cluster]', or one process",
            ) from None
        settings = config.set(_SETTINGS | {"distributed.nanny.pre-spawn-environ": worker_threads()})
        self._left = contextlib.ExitStack()
        self._left.enter_context(settings)
        self._left.enter_context(_silence(_SILENCED_LOGGERS))
        before = dict(os.environ)
        try:
            self._connect(partial(start_local_cluster, module=self._made[0].__module__), Client)
        except BaseException:  # also Ctrl-C, while jobs wait in a queue
            self.__exit__()
            raise
        finally:  # nannies run in this process, and give its environment the threads of their workers
            names = {name for name, _ in before.items() ^ os.environ.items()}
            original = {name: before.get(name) for name in names}
            _set_environment(original)
        self._left.callback(_set_environment, original)  # again: of workers that nannies started later
        return self

    def _connect(self, start_here: Callable[[int], Any], client: Callable[..., Any]) -> None:
        if self.scheduler is None:
            self._cluster = (self._start or start_here)(self._workers)
        first = 1 if self.scheduler or self._start else self._workers
        try:
            self._client = client(self._cluster or self.scheduler, timeout=_TIMEOUT)
            self._client.wait_for_workers(first, timeout=None if self._start else _TIMEOUT)
        except (OSError, TimeoutError, ValueError) as error:
            where = self.scheduler or "this machine"
            raise MbdError(f"no worker answers on {where} after {_TIMEOUT} s: {error}") from error

    def __exit__(self, *_: object) -> None:
        with self._left, contextlib.suppress(TimeoutError):  # what is being started just now ends with this process
            if self._client is not None:
                self._client.close(timeout=5)
            if self._cluster is not None:
                self._cluster.close(timeout=5)

    def for_problem(self, problem: Any) -> Self:
        """The same workers for the problem by another number of steps, which each of them makes of its own."""
        other = copy.copy(self)
        other.problem = problem
        return other

    @property
    def factory(self) -> tuple[Callable[..., NonlinearProgram], tuple[Any, ...]]:
        """The function that makes the problem on a worker, and its arguments: steps are chosen once, in this process."""
        has_steps = hasattr(type(self.problem), "at_steps")  # a wrapper that passes it on would lose its evaluations
        chosen = self.problem.steps if has_steps and self.problem.chooses_steps else None
        return (at_steps, (*self._made, chosen)) if chosen else self._made

    @property
    def size(self) -> int:
        """The number of workers at present, at least 1."""
        return max(1, len(self._client.scheduler_info(n_workers=-1).get("workers", ())))  # a lost scheduler names none

    @property
    def parallel_batches(self) -> int:
        """The number of batches under evaluation: one for each worker, those that are still queuing included."""
        return self._workers if self._start else self.size

    @property
    def lanes(self) -> int:
        """The number of designs that fill all workers: a full batch for each."""
        return LANES * self.parallel_batches

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n], a piece on each worker."""
        return self.begin(X, gradients, 1).evaluations()

    def begin(self, X: np.ndarray, gradients: bool, concurrent: int) -> WorkerBatch:
        """Begin to evaluate designs [lanes, n], one of `concurrent` batches under evaluation."""
        count = max(min(self.size // concurrent, len(X)), math.ceil(len(X) / LANES))
        parts = np.array_split(X, count)
        futures = [self._client.submit(evaluate_piece, *self.factory, part, gradients, pure=False) for part in parts]
        return WorkerBatch(self, [len(part) for part in parts], futures)

    def cancel(self, futures: list[Any]) -> None:
        """Stop the evaluation of futures, unless the scheduler has ended."""
        if self._client.status == "running":
            self._client.cancel(futures, force=True)


def _set_environment(values: Mapping[str, str | None]) -> None:
    """Set variables of the environment; None: remove one."""
    for name, x in values.items():
        if x is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = x


@contextlib.contextmanager
def _silence(names: Iterable[str]) -> Iterator[None]:
    """Silence loggers that write tracebacks; an MbdError reports what matters."""
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@dataclass
class WorkerBatch:
    """A batch under evaluation by workers, see batch.py."""

    workers: Workers
    sizes: list[int]
    futures: list[Any]  # of Dask, one for each piece

    @property
    def done(self) -> bool:
        return all(future.done() for future in self.futures)

    def notify(self, call: Callable[[], None]) -> None:
        for future in self.futures:
            future.add_done_callback(lambda _: call())

    def evaluations(self) -> list[Evaluation]:
        from distributed import CancelledError, KilledWorker  # pyright: ignore[reportMissingImports]

        evaluations: list[Evaluation] = []
        try:
            for size, future in zip(self.sizes, self.futures, strict=True):
                try:
                    evaluations += future.result()
                except KilledWorker:
                    evaluations += [
                        Evaluation.failure(f"failed: {_MAX_DEATHS} workers died of it", self.workers.rows)
                    ] * size
        except CancelledError as error:
            raise MbdError(f"the scheduler {self.workers.scheduler or ''} is gone: {error}") from error
        except BaseException:
            self.cancel()
            raise
        for future in self.futures:
            future.release()  # here, as a Ctrl-C during `__del__` would be lost
        return evaluations

    def cancel(self) -> None:
        self.workers.cancel(self.futures)


class Processes(Workers):
    """`problem` with its batches evaluated by `count` processes of this machine (default: one for each core).

    problem  such as a Problem; every process has a copy of it as it is when the `with` block begins
    count    number of processes

    Every other attribute is that of the problem itself. It works inside a `with` block only. A design during which three
    processes have died is a failed evaluation. Every process imports the script that uses this: keep its actions under
    `if __name__ == "__main__":`. Needs the extra `cluster`.

    >>> energy = mbd.Integral(mbd.StrainEnergy("arm"))
    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-90, 90]))
    >>> shared = mbd.optimization.Processes(problem, 2)
    >>> shared.names == problem.names  # with shared: multistart(shared, starts=sobol(32, seed=1))
    True
    """

    def __init__(self, problem: NonlinearProgram, count: int | None = None) -> None:
        if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
            raise InputError("count", count, "a positive integer", noun="count of processes")
        require_problem(problem)
        super().__init__(unpickle_problem, pickle_problem(problem), workers=count or 0, problem=problem)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "problem" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.problem, name)

    @property
    def coarse(self) -> Processes | None:
        """A less accurate problem for the first part of a search, on the same processes; None: there is none."""
        return self._with(getattr(self.problem, "coarse", None))

    def refined(self, x: np.ndarray) -> Processes | None:
        """A problem as accurate as a design [n] requires, on the same processes; None: this problem is accurate enough."""
        refine = getattr(self.problem, "refined", None) if hasattr(type(self.problem), "refined") else None
        return None if refine is None else self._with(refine(x))

    def _with(self, problem: Any) -> Processes | None:
        return None if problem is None else self.for_problem(problem)

    def wait(self) -> None:
        """Wait until every process has the problem and has prepared its motions."""
        self._client.run(_warm_up, *self.factory)


def evaluate_piece(
    make: Callable[..., NonlinearProgram], arguments: tuple, X: np.ndarray, gradients: bool
) -> list[Evaluation]:
    """Evaluate designs [lanes, n] of the problem that `make` makes of its arguments, on a worker."""
    return _problem_of_worker(make, arguments).evaluate(X, gradients)


@cache
def _problem_of_worker(make: Callable[..., NonlinearProgram], arguments: tuple[Any, ...]) -> NonlinearProgram:
    use_one_thread()
    os.environ.setdefault(THREADS, "1")
    brief_warnings()
    return make(*arguments)


def at_steps(make: Callable[..., Any], arguments: tuple[Any, ...], steps: int) -> NonlinearProgram:
    """Return the problem that `make` makes of its arguments, by another number of steps."""
    return make(*arguments).at_steps(steps)


def pickle_problem(problem: NonlinearProgram) -> tuple[bytes, torch.dtype]:
    """Return the arguments of `unpickle_problem` in another process; InputError for a problem that cannot be pickled."""
    try:
        return cloudpickle.dumps(problem), torch.get_default_dtype()
    except Exception as error:  # of whatever the problem holds
        allowed = "a problem that can be pickled, whose responses hold no locks, files or threads"
        raise InputError(
            "problem",
            problem,
            allowed,
            noun=f"problem {problem!r}",
            state=f"cannot be sent to other processes: {error}",
        ) from error


def unpickle_problem(pickled: bytes, dtype: torch.dtype) -> NonlinearProgram:
    torch.set_default_dtype(dtype)
    return cloudpickle.loads(pickled)


def _warm_up(make: Callable[..., NonlinearProgram], arguments: tuple[Any, ...]) -> None:
    problem = _problem_of_worker(make, arguments)
    problem.evaluate(np.asarray(problem.start)[None], True)
