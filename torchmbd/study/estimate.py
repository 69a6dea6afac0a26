"""What a study will cost, from two short motions of its own first batch: `torchmbd check`.

    seconds = batches (structure + steps * step)          two lengths tell the structure stage and a step apart
    memory  = base + lanes * (bytes of a motion) * 3      the motion, its work arrays, the responses on the way

Simulations: of a sweep its points; of an optimization at most 1.5 per iteration of every start, as the shipped studies
do (README), and no start ends early. Methods that choose their steps: a time unit in place of a step.
Measured eagerly, on this machine, with whatever else it does. Checked in tests/study/test_estimate.py.
"""

from __future__ import annotations

import math
import resource
import time
import warnings
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from torchmbd.design import Problem
from torchmbd.design.response_spec import words
from torchmbd.integrate import Trajectory, simulate
from torchmbd.optimization.multistart.workers import LANES
from torchmbd.study.assemble import increments, problem_of, sought, starts_of, tolerances
from torchmbd.study.evaluations import Evaluations
from torchmbd.study.load import FiguresPlan, Plan
from torchmbd.study.paths import evaluations_file, problem_key
from torchmbd.study.schema import Optimizer
from torchmbd.tracking.store import store_uri

_PER_ITERATION = 1.5  # analyses
_SHARES = (0.02, 0.06)  # of the motion that are measured
_FEWEST = 4  # steps
_COPIES = 3.0


@dataclass(frozen=True)
class Estimate:
    """Cost of a study on this machine: simulations at most, seconds of one batch and of all, peak memory [bytes]."""

    simulations: int
    lanes: int
    batch_seconds: float
    seconds: float
    memory: float


def estimate(plan: Plan, problem: Problem) -> Estimate:
    """Measure two short motions and extrapolate."""
    starts = np.repeat(_starts(plan, problem), getattr(sought(plan, problem), "simulations", 1), axis=0)
    gradients = plan.study.sweep is None
    X = starts[:LANES]
    optimizer = plan.study.optimizer or Optimizer()
    each = math.ceil(_PER_ITERATION * optimizer.max_iterations) if gradients else 1
    times, size = [], 0.0
    shares = _shares(plan.study.simulate.steps)
    _short(plan, problem, X[:1], gradients, shares[0])  # what is done once per process does not count
    for share in shares:
        began = time.perf_counter()
        size = _bytes(_short(plan, problem, X, gradients, share)) / share
        times.append((share, time.perf_counter() - began))
    (a, fast), (b, slow) = times[0], times[-1]
    rate = max((slow - fast) / (b - a), 0.0) if b > a else fast / a
    batch = max(fast - rate * a, 0.0) + rate
    batches = each * math.ceil(len(starts) / LANES)
    base = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Estimate(each * len(starts), len(X), batch, batches * batch, base + _COPIES * size)


def _starts(plan: Plan, problem: Problem) -> np.ndarray:
    if plan.study.sweep is not None:
        [span] = plan.study.sweep.values()
        return np.tile(problem.start, (span.count + 1, 1))
    return starts_of(plan, problem.start).points(sought(plan, problem))


def _shares(steps: int | None) -> list[float]:
    """Return how much of the motion is simulated, twice; of a motion of few steps, whole steps."""
    if steps is None:
        return list(_SHARES)
    first = max(1, min(max(_FEWEST, round(_SHARES[0] * steps)), steps // 2))
    return [first / steps, min(3 * first, steps) / steps]


def _short(plan: Plan, problem: Problem, X: np.ndarray, gradients: bool, share: float) -> Trajectory:
    """Simulate the beginning of the motion."""
    told = plan.study.simulate
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a few steps tell what they cost, not how good they are
        return simulate(
            plan.system,
            share * told.duration,
            method=told.method,
            steps=None if told.steps is None else round(share * told.steps),
            gradients=problem.gradients if gradients else "none",
            variables=problem.space.variables,
            backend=told.backend,
            start=told.start,
            designs=problem.space.designs(X),
            phases=plan.phases,
            **told.options,
        )


def _bytes(motion: Trajectory) -> float:
    """Bytes of the coordinates, rates and accelerations of a motion with their tangents, or cotangents."""
    numbers = sum(x.numel() for x in (motion.q, motion.v, motion.a))
    copies = {"forward": 1 + len(motion.parameters), "reverse": 2}.get(motion.stats["gradients"], 1)
    return 8.0 * numbers * copies


def print_estimate(plan: Plan | FiguresPlan, console: Console) -> None:
    """Print what a valid file is about and what it will cost."""
    if isinstance(plan, FiguresPlan):
        console.print(f"{plan.file} is valid: figures by {plan.study.figures}", markup=False, soft_wrap=True)
        return
    store_uri(plan.study.tracking.uri)  # refused here, not when the study is over
    problem = problem_of(plan)
    console.print(
        f"{plan.file} is valid: {words(plan.study.minimize)}, {_count(len(plan.columns.names), 'design variable')}, "
        f"{_count(len(plan.study.subject_to), 'constraint')}"
        + ", mean over the tolerances"
        * bool(tolerances(plan).any()),
        markup=False,
        soft_wrap=True,
    )
    cost = estimate(plan, problem)
    store = Evaluations(evaluations_file(), problem_key(plan)) if evaluations_file().exists() else None
    known = f"; {store.count()} evaluations of this problem are in the store already" if store else ""
    console.print(
        f"at most about {cost.simulations} simulations in batches of {cost.lanes}, {_time(cost.batch_seconds)} each: "
        f"{_time(cost.seconds)} in one process, {cost.memory / 2**30:.1f} GiB{known}"
        + "; designs on the steps are looked at after that"
        * any(increments(plan)),
        markup=False,
        soft_wrap=True,
    )


def _count(n: int, what: str) -> str:
    return f"{n or 'no'} {what}{'s' * (n != 1)}"


def _time(seconds: float) -> str:
    """Write a time in a fitting unit: `12 s`, `3.4 h`."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
