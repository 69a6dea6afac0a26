"""Cores: evaluations with gradients with one thread and two, in one process and in two, and the share that is serial.

cores_ratio    32 designs: wall time with one thread over wall time with two
cores_serial   128 designs, one thread: processor time outside of what threads share, over all processor time

    1 / gain of n threads = serial + (1 - serial) / n

The share depends less on other load of the machine than the ratio does. Runs with one and two threads take turns, and so do
those with one process and two, each of which evaluates its share of the designs.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any
from unittest.mock import patch

import numpy as np

import torchmbd as mbd
from experiments.benchmark.cases import Case, compilation, compiled_ready, crank3
from experiments.benchmark.report import Grid, Result, Settings
from torchmbd.process import use_one_thread

DESIGNS, FIGURE, SERIAL, STEPS = (32, 128), 32, 128, 500
REPEAT = 3  # of each, in turns: the part takes about a minute
MANY = 16  # cores for which the gain is predicted
ANGLES = "rod.laminate.angles"
_NATIVE = [f"torchmbd.extensions.native.{name}" for name in ("start", "steps", "backward", "compiled_products")]
_SHARED = ["torchmbd.math.threads", *_NATIVE]
_worker: dict[str, Any] = {}


def cores(settings: Settings) -> Result:
    """See the module header."""
    figures: dict[str, float | None] = dict.fromkeys(("cores_ratio", "cores_serial"))
    case = crank3(modes=3, cells=(6, 2)) if settings.quick else crank3()
    if settings.quick or not compiled_ready(case.dynamics(1, gradients=False)):
        return Result(figures)
    rows = []
    with compilation(True), multiprocessing.get_context("spawn").Pool(2, _begin) as pool:
        pool.map(_evaluate_share, [case.designs(1)[ANGLES].numpy()] * 4)
        for lanes in DESIGNS:
            X = case.designs(lanes)[ANGLES].numpy()
            problem = _problem(case)
            with mbd.threads(1):
                serial = _serial_share(problem, X, REPEAT)
            one, two, processes = _wall_times(
                [
                    lambda problem=problem, X=X: _with_threads(1, problem, X),
                    lambda problem=problem, X=X: _with_threads(2, problem, X),
                    lambda X=X: pool.map(_evaluate_share, np.array_split(X, 2), chunksize=1),
                ],
                REPEAT,
            )
            gains = [1.0 / (serial + (1.0 - serial) / n) for n in (2, MANY)]
            rows.append(
                [lanes, *(1e3 * x / lanes for x in (one, two, processes)), one / two, one / processes, serial, *gains]
            )
            if lanes == FIGURE:
                figures["cores_ratio"] = one / two
            if lanes == SERIAL:
                figures["cores_serial"] = serial
    columns = ["designs", "one thread", "two threads", "two processes", "gain by threads", "by processes"]
    columns += ["serial share", "predicted, 2 cores", f"{MANY} cores"]
    load = os.getloadavg()[0]
    title = f"evaluation with gradients, wall ms per design; load of the machine at the end {load:.1f}"
    return Result(figures, [Grid(title, columns, rows)])


def _problem(case: Case) -> mbd.Problem:
    energy = mbd.StrainEnergy("rod")
    return mbd.Problem(case.system, case.duration, mbd.Integral(energy), [mbd.Max(energy) <= 1.0], steps=STEPS)


def _begin() -> None:
    use_one_thread()
    mbd.threads(1)
    _worker["problem"] = _problem(crank3())


def _evaluate_share(X: np.ndarray) -> None:
    _worker["problem"].evaluate(X, True)


def _with_threads(count: int, problem: mbd.Problem, X: np.ndarray) -> None:
    with mbd.threads(count):
        problem.evaluate(X, True)


def _wall_times(functions: list[Callable[[], object]], repeat: int) -> list[float]:
    """Wall seconds of the fastest of several runs, taken in turns."""
    seconds: list[list[float]] = [[] for _ in functions]
    for _ in range(repeat):
        for function, times in zip(functions, seconds, strict=True):
            start = time.perf_counter()
            function()
            times.append(time.perf_counter() - start)
    return [min(times) for times in seconds]


def _serial_share(problem: mbd.Problem, X: np.ndarray, repeat: int) -> float:
    """Share of the processor time outside of pieces of blocks, of the run that takes the least."""
    runs = []
    with _clock() as shared:
        problem.evaluate(X, True)
        for _ in range(repeat):
            shared[0], start = 0.0, time.thread_time()
            problem.evaluate(X, True)
            whole = time.thread_time() - start
            runs.append((whole, 1.0 - shared[0] / whole))
    return min(runs)[1]


@contextmanager
def _clock() -> Iterator[list[float]]:
    """Processor seconds of the calling thread inside of `run_blocks`, which one thread runs."""
    shared, modules = [0.0], [import_module(name) for name in _SHARED]
    real, depth = modules[0].run_blocks, [0]

    def timed(*arguments: Any, **options: Any) -> int:
        start, depth[0] = time.thread_time(), depth[0] + 1
        try:
            return real(*arguments, **options)
        finally:
            depth[0] -= 1
            if depth[0] == 0:  # not of a piece that shares its own work
                shared[0] += time.thread_time() - start

    with ExitStack() as patches:
        for module in modules:
            patches.enter_context(patch.object(module, "run_blocks", timed))
        yield shared
