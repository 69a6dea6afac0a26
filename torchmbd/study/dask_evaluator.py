"""Evaluation on Dask workers: a cluster on this machine, any scheduler by its address, or jobs of SLURM (cluster.py).

Every worker has a batch of its own under way, of LANES designs at most, and with many starts a second one waiting for it:
the starts of a study are in as many groups (torchmbd.optimization.multistart.batched), and no worker waits for another.
Where there are
fewer batches than workers, each is cut into pieces. A worker builds the model once, from the experiment file's own words, and
evaluates a piece as one batch. Pieces are pure functions of the designs: one that a worker takes with it when it dies is
evaluated again by another, and nothing depends on which. What is evaluated together moves gradients in their seventh digit (an
iteration ends for all designs of a batch at once): studies agree to the last digit where they have as many workers, whoever
dies.
Half a batch takes more than half its time (a step costs the same operations): it is many starts that workers speed up.
The optimizers, the store of evaluations and the tracker stay with the parent, so a study is the same on any cluster.

Assumed: workers see the model's file at the same path, and run the same torchmbd (a hash of both is compared).
One thread each: a worker must be started with OMP_NUM_THREADS=1 (the local cluster and SLURM's jobs do).
Dask, its messages are pickled: connect to schedulers that you trust only. The local cluster answers to the study alone
(local_cluster.py).
Checked in tests/study/test_dask_evaluator.py, tests/study/test_cluster.py.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from torchmbd.design.response_spec import measure_of
from torchmbd.errors import InputError, MbdError
from torchmbd.optimization import Evaluation
from torchmbd.process import ONE_THREAD, brief_warnings, use_one_thread
from torchmbd.study.assemble import problem_of
from torchmbd.study.cluster import Slurm, load_cluster
from torchmbd.study.columns import Columns
from torchmbd.study.load import Plan
from torchmbd.study.model import build_model, find_model
from torchmbd.study.paths import problem_key
from torchmbd.study.schema import Study

LANES = 64  # designs in one batch of one process: more gain little, and cost memory
_DEATHS = 3  # of workers under the same piece, until its designs count as failed
_SETTINGS: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": _DEATHS,
    "distributed.worker.multiprocessing-method": "forkserver",
    "distributed.nanny.pre-spawn-environ": ONE_THREAD,
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",  # 20 ms by itself: a wake-up that interrupts the numbers
}
_LOUD = ("distributed", "distributed.client", "tornado.application")
_ADDRESS = re.compile(r"(tcp|tls|ws|wss)://\S+:\d+")
_START = 60  # seconds to wait for a scheduler, and for workers that nobody has to queue for


class Farm:
    """A context manager that evaluates designs of one plan on workers.

    rows       constraints of the problem
    workers    processes of the local cluster (0: one for each core) or of SLURM's jobs
    scheduler  address of a scheduler, or a cluster file (.yaml); None: a local cluster
    """

    def __init__(self, plan: Plan, key: str, rows: int, workers: int = 0, scheduler: str | None = None) -> None:
        if workers < 0:
            raise InputError(f"workers = {workers}: must be 0 (one for each core) or more")
        self._slurm: Slurm | None = None
        if scheduler is not None and scheduler.endswith((".yaml", ".yml")):
            self._slurm = load_cluster(scheduler)
            if not workers:
                raise InputError("workers = 0: must be 1 or more, of all jobs together, with a cluster file")
        elif scheduler is not None and not _ADDRESS.fullmatch(scheduler):
            raise InputError(
                f"scheduler = {scheduler!r}: allowed: tcp://host:8786, tls:, ws:, wss:, or a cluster file .yaml"
            )
        self.rows, self._workers, self.scheduler = rows, workers or os.cpu_count() or 1, scheduler
        folder = str(plan.file.absolute().parent)
        self._order = (json.dumps(plan.study.resolved()), folder, key)

    def __enter__(self) -> Self:
        try:
            from dask import config  # pyright: ignore[reportMissingImports]
            from distributed import Client  # pyright: ignore[reportMissingImports]

            from torchmbd.study.local_cluster import start_local_cluster
        except ModuleNotFoundError as error:
            raise InputError(
                f"workers need the package {error.name!r}: pip install 'torchmbd[cluster]'; allowed without: --workers 1"
            ) from None
        config.set(_SETTINGS)
        for name in _LOUD:  # with tracebacks; what matters of it is told by an MbdError
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._client: Any = None
        self._cluster: Any = None
        if self._slurm:
            self._cluster = self._slurm.start(self._workers)
        elif self.scheduler is None:
            self._cluster = start_local_cluster(self._workers)
        try:
            self._client = Client(self._cluster or self.scheduler, timeout=_START)
            first = 1 if self.scheduler else self._workers
            self._client.wait_for_workers(first, timeout=None if self._slurm else _START)
        except BaseException as error:  # also Ctrl-C, while jobs wait in a queue
            self.__exit__()
            if not isinstance(error, (OSError, TimeoutError, ValueError)):
                raise
            where = self.scheduler or "this machine"
            raise MbdError(f"no worker answers on {where} after {_START} s: {error}") from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._client is not None:
            self._client.close(timeout=5)
        if self._cluster is not None:
            self._cluster.close(timeout=5)

    @property
    def size(self) -> int:
        """Workers there are now."""
        return max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    @property
    def at_once(self) -> int:
        """Batches under way at once: one for every worker, those that SLURM will still start too."""
        return self._workers if self._slurm else self.size

    @property
    def lanes(self) -> int:
        """Designs that are worth asking for at once: a full batch for every worker."""
        return LANES * self.at_once

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n], a piece on each worker."""
        return self.begin(X, gradients, 1).evaluations()

    def begin(self, X: np.ndarray, gradients: bool, among: int) -> Pieces:
        """Begin to evaluate designs [lanes, n], one of `among` batches under way."""
        count = max(min(self.size // among, len(X)), math.ceil(len(X) / LANES))
        parts = np.array_split(X, count)
        futures = [self._client.submit(evaluate_piece, *self._order, part, gradients, pure=False) for part in parts]
        return Pieces(self, [len(part) for part in parts], futures)

    def dismiss(self, futures: list[Any]) -> None:
        """Stop what nobody waits for, unless the scheduler is gone."""
        if self._client.status == "running":
            self._client.cancel(futures, force=True)


@dataclass
class Pieces:
    """A batch on workers (torchmbd.optimization.batch)."""

    farm: Farm
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

        found: list[Evaluation] = []
        try:
            for size, future in zip(self.sizes, self.futures, strict=True):
                try:
                    found += future.result()
                except KilledWorker:
                    found += [Evaluation.failure(f"failed: {_DEATHS} workers died of it", self.farm.rows)] * size
        except CancelledError as error:
            raise MbdError(f"the scheduler {self.farm.scheduler or ''} is gone: {error}") from error
        except BaseException:
            self.cancel()
            raise
        for future in self.futures:
            future.release()  # left to `__del__`, a Ctrl-C that comes in there would be lost
        return found

    def cancel(self) -> None:
        self.farm.dismiss(self.futures)


def evaluate_piece(study: str, folder: str, key: str, X: np.ndarray, gradients: bool) -> list[Evaluation]:
    """What a worker does: evaluate designs [lanes, n] of the study that `study` (JSON) and `folder` describe."""
    return _problem(study, folder, key).evaluate(X, gradients)


@cache
def _problem(study_json: str, folder: str, key: str) -> Any:
    use_one_thread()
    brief_warnings()
    study = Study.model_validate(json.loads(study_json))
    system = build_model(find_model(study.model, Path(folder)), study.options)
    plan = Plan(
        study, system, Columns.of(study.design, system, measure_of(study.minimize).rows), Path(folder) / "worker"
    )
    if problem_key(plan) != key:
        raise MbdError("a worker has another model file or another torchmbd than the study; allowed: the same on all")
    return problem_of(plan)
