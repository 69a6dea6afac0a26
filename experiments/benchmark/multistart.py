"""A whole multistart beside the same optimizer that drives the peer by differences.

Three-layer slider-crank, integral of U with its peak held, Sobol starts, the same limits of iterations and the same number
of steps for both codes. Ours is one process with a thread for each core, as the command has it without --workers, and
beside it two processes, each with a share of every batch; the peer has two processes. A batch of the peer has all designs and
their forward differences; modes come from our structure stage, in batches, inside the time of both. Processes are there, and
the limit is known to them, before the clock starts.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from functools import cached_property
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from experiments.benchmark.cases import compilation, compiled_ready, measures
from experiments.benchmark.report import Cell, Grid, Result, Settings, ratio
from torchmbd.examples.slider_crank import DURATION, build
from torchmbd.optimization import Evaluation
from torchmbd.process import use_one_thread

ANGLES = "rod.laminate.angles"
STEPS, STARTS, ITERATIONS = 500, 32, 30
METHODS = ("slsqp", "mmfd")
DIFFERENCE = 1e-4  # [rad]
PROCESSES = 2


def own_problem(steps: int) -> mbd.Problem:
    """Table 3, L3."""
    U = mbd.StrainEnergy("rod")
    limits = [mbd.Max(U) <= "initial"]
    return mbd.Problem(
        build(3, joint="spherical"), DURATION, mbd.Integral(U), limits, bounds=mbd.deg([-90, 90]), steps=steps
    )


_worker: dict[str, Any] = {}


def _begin(peer: bool, begun: Any) -> None:
    sys.stdout = sys.stderr  # standard output belongs to the JSON object
    use_one_thread()
    _worker["system"] = build(3, joint="spherical")
    if peer:
        import experiments.peers.exudyn_peer  # noqa: F401  before the clock starts
    begun.wait()


def _peer_measures(X: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
    """Peak and integral of U [designs, 2], and the seconds that the peer integrated."""
    from experiments.peers.exudyn_peer import slider_crank

    runs = [
        run(DURATION, steps) for run in slider_crank(_worker["system"], {ANGLES: torch.tensor(X, dtype=torch.float64)})
    ]
    values = torch.stack(
        [measures(torch.tensor(x.t, dtype=torch.float64), torch.tensor(x.U, dtype=torch.float64)) for x in runs]
    )
    return values.numpy(), sum(x.seconds for x in runs)


class PeerProblem:
    """The same problem, evaluated by the peer; gradients by forward differences."""

    def __init__(self, ours: mbd.Problem, pool: Any, steps: int):
        self.pool, self.steps = pool, steps
        self.start, self.lower, self.upper, self.names, self.period = (
            ours.start,
            ours.lower,
            ours.upper,
            ours.names,
            ours.period,
        )
        self.equalities = ours.equalities
        self.seconds = 0.0

    @cached_property
    def limit(self) -> float:
        return float(self._measures(self.start[None])[0, 0])

    def _measures(self, X: np.ndarray) -> np.ndarray:
        parts = [x for x in np.array_split(X, PROCESSES) if len(x)]
        answers = self.pool.starmap(_peer_measures, [(x, self.steps) for x in parts])
        self.seconds += sum(seconds for _, seconds in answers)
        return np.concatenate([values for values, _ in answers])

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n]."""
        X = np.asarray(X, dtype=float)
        limit, n = self.limit, X.shape[1]
        shifts = np.concatenate([np.zeros((1, n)), DIFFERENCE * np.eye(n)]) if gradients else np.zeros((1, n))
        y = self._measures((X[:, None] + shifts).reshape(-1, n)).reshape(len(X), -1, 2)
        result = []
        for row in y:
            peak, integral = row[0]
            if not np.isfinite(row).all():
                result.append(Evaluation.failure("Exudyn failed", 1))
                continue
            constraint = np.array([peak / limit - 1.0])
            if gradients:
                slope = (row[1:] - row[0]).T / DIFFERENCE
                result.append(Evaluation(float(integral), constraint, slope[1], slope[:1] / limit))
            else:
                result.append(Evaluation(float(integral), constraint))
        return result


def run(problem: Any, method: str, starts: int, iterations: int) -> tuple[float, Any]:
    """Wall seconds of a multistart, and its result."""
    begin = time.perf_counter()
    study = mbd.optimization.multistart(
        problem, method=method, starts=mbd.optimization.sobol(starts, seed=7), max_iterations=iterations
    )
    return time.perf_counter() - begin, study


def multistart(settings: Settings, starts: int = STARTS, iterations: int = ITERATIONS, steps: int = STEPS) -> Result:
    """Wall time of both, for each method; `multistart` is the ratio over all methods."""
    if settings.quick:
        return Result({"multistart": None})
    use_one_thread()  # as the command line does
    ours = own_problem(steps)
    ready = compiled_ready(ours.system.dynamics())
    rows: list[list[Cell]] = []
    total = {"ours": 0.0, "peer": 0.0}
    spawn = multiprocessing.get_context("spawn")
    begun = spawn.Barrier(1 + PROCESSES)
    with spawn.Pool(PROCESSES, _begin, (bool(settings.peer), begun)) as pool:
        begun.wait()
        for method in METHODS:
            with compilation(ready):
                seconds, study = run(own_problem(steps), method, starts, iterations)
                rows.append([f"torchmbd, {method}", seconds, *_summary(study), None])
                total["ours"] += seconds
                with mbd.optimization.Processes(own_problem(steps), PROCESSES) as problem:
                    problem.wait()
                    seconds, study = run(problem, method, starts, iterations)
            rows.append([f"torchmbd, {method}, processes", seconds, *_summary(study), None])
            if not settings.peer:
                continue
            peer = PeerProblem(ours, pool, steps)
            _ = peer.limit  # known before the clock starts, as to our processes
            seconds, study = run(peer, method, starts, iterations)
            total["peer"] += seconds
            rows.append([f"Exudyn, {method}", seconds, *_summary(study), peer.seconds / PROCESSES])
    figure = ratio(total["peer"] if settings.peer else None, total["ours"])
    title = f"multistart, L3, {starts} starts, at most {iterations} iterations, {steps} steps: wall seconds"
    columns = ["code, method", "s", "analyses", "gradients", "converged", "best integral of U", "of it integration"]
    return Result({"multistart": figure}, [Grid(title, columns, rows)])


def _summary(study: Any) -> list[Cell]:
    best = float("nan") if study.best is None else float(study.best.value)
    return [study.analyses, study.gradient_evaluations, study.converged, best]
