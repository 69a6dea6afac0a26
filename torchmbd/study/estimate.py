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
from torchmbd.design.words import words
from torchmbd.integrate import Trajectory, simulate
from torchmbd.optimization.multistart.workers import LANES
from torchmbd.study.evaluations import Evaluations
from torchmbd.study.load import FiguresPlan
from torchmbd.study.paths import evaluations_file, problem_key
from torchmbd.study.settings import StudySettings

_PER_ITERATION = 1.5  # analyses
_SHARES = (0.02, 0.06)  # of the motion that are measured
_FEWEST = 4  # steps
_COPIES = 3.0
_SOUGHT = {"expected": ", mean over the tolerances", "worst": ", worst case over the tolerances"}  # of RobustProblem


@dataclass(frozen=True)
class Estimate:
    """Cost of a study on this machine: simulations at most, seconds of one batch and of all, peak memory [bytes]."""

    simulations: int
    lanes: int
    batch_seconds: float
    seconds: float
    memory: float


def estimate(study: StudySettings, problem: Problem) -> Estimate:
    """Measure two short motions and extrapolate."""
    starts = np.repeat(_starts(study), getattr(study.problem, "simulations", 1), axis=0)
    gradients = study.sweep is None
    X = starts[:LANES, : len(problem.names)]
    each = math.ceil(_PER_ITERATION * study.max_iterations) if gradients else 1
    times, size = [], 0.0
    shares = _shares(problem.simulation["steps"])
    _short(problem, X[:1], gradients, shares[0])  # what is done once per process does not count
    for share in shares:
        began = time.perf_counter()
        size = _bytes(_short(problem, X, gradients, share)) / share
        times.append((share, time.perf_counter() - began))
    (a, fast), (b, slow) = times[0], times[-1]
    rate = max((slow - fast) / (b - a), 0.0) if b > a else fast / a
    batch = max(fast - rate * a, 0.0) + rate
    batches = each * math.ceil(len(starts) / LANES)
    base = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Estimate(each * len(starts), len(X), batch, batches * batch, base + _COPIES * size)


def _starts(study: StudySettings) -> np.ndarray:
    if study.sweep is not None:
        return np.tile(study.problem.start, (len(study.sweep[1]) + 1, 1))
    return study.points


def _shares(steps: int | None) -> list[float]:
    """Return how much of the motion is simulated, twice; of a motion of few steps, whole steps."""
    if steps is None:
        return list(_SHARES)
    first = max(1, min(max(_FEWEST, round(_SHARES[0] * steps)), steps // 2))
    return [first / steps, min(3 * first, steps) / steps]


def _short(problem: Problem, X: np.ndarray, gradients: bool, share: float) -> Trajectory:
    """Simulate the beginning of the motion."""
    settings = dict(problem.simulation)
    steps = settings.pop("steps")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a few steps tell what they cost, not how good they are
        return simulate(
            problem.system,
            share * problem.duration,
            steps=None if steps is None else round(share * steps),
            gradients=problem.gradients if gradients else "none",
            variables=problem.space.variables,
            designs=problem.space.designs(X[:, : len(problem.space.names)]),
            **settings,
        )


def _bytes(motion: Trajectory) -> float:
    """Bytes of the coordinates, rates and accelerations of a motion with their tangents, or cotangents."""
    numbers = sum(x.numel() for x in (motion.q, motion.v, motion.a))
    copies = {"forward": 1 + len(motion.parameters), "reverse": 2}.get(motion.stats["gradients"], 1)
    return 8.0 * numbers * copies


def print_estimate(study: StudySettings | FiguresPlan, console: Console) -> Estimate | None:
    """Print what a valid study is about and what it will cost; return its cost, None where nothing is simulated."""
    if isinstance(study, FiguresPlan):
        console.print(f"{study.file} is valid: figures by {study.study.figures}", markup=False, soft_wrap=True)
        return None
    problem = study.simulated
    valid = f"{study.name if study.origin is None else study.origin.file} is valid"
    if not isinstance(problem, Problem):
        console.print(f"{valid}: {_count(len(study.columns.names), 'design variable')}", markup=False)
        return None
    asked = ", ".join(study.problem.criteria) if study.front else words(problem.objective)
    others = len(study.problem.criteria) - 1 if study.front else 0
    console.print(
        f"{valid}: {asked}, {_count(len(study.columns.names), 'design variable')}, "
        f"{_count(len(problem.constraints) - others, 'constraint')}"
        + _SOUGHT.get(getattr(study.problem, "kind", ""), ""),
        markup=False,
        soft_wrap=True,
    )
    cost = estimate(study, problem)
    store = Evaluations(evaluations_file(), problem_key(problem)) if evaluations_file().exists() else None
    known = f"; {store.count()} evaluations of this problem are in the store already" if store else ""
    console.print(
        f"at most about {cost.simulations} simulations in batches of {cost.lanes}, {_time(cost.batch_seconds)} each: "
        f"{_time(cost.seconds)} in one process, {cost.memory / 2**30:.1f} GiB{known}"
        + "; designs on the steps are looked at after that"
        * any(study.increments),
        markup=False,
        soft_wrap=True,
    )
    return cost


def _count(n: int, what: str) -> str:
    return f"{n or 'no'} {what}{'s' * (n != 1)}"


def _time(seconds: float) -> str:
    """Write a time in a fitting unit: `12 s`, `3.4 h`."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"
