"""Estimate of the cost of a study, from motions of its first designs: `torchmbd check`.

    seconds = once + batches * seconds of a batch   once: loading and compiling code, the verification, pictures, MLflow

One design is evaluated twice, which tells what is done once. Then a batch is evaluated, with its responses and gradients: the
first of the study, or as many of its designs as there is time for.

The number of simulations depends on the kind of study:

    sweep         one for each point
    optimization  from fewest to most of each start (optimization/effort.py); no start ends early
    front         as an optimization for each anchor, from each start and from the other anchors, and for each point

Times are measured on this machine without other load; the memory is the peak of `check` itself.
Checked in tests/study/test_estimate.py.
"""

from __future__ import annotations

import contextlib
import math
import resource
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from rich.console import Console

from torchmbd.design import Problem
from torchmbd.design.scenarios import Scenarios
from torchmbd.design.verification import advice
from torchmbd.design.words import words
from torchmbd.diagnosis.truncation import static_truncation
from torchmbd.errors import MbdError
from torchmbd.optimization import effort
from torchmbd.optimization.multistart.workers import LANES
from torchmbd.optimization.pareto import group_sizes
from torchmbd.progress import begin_stage, stages_told
from torchmbd.results.answer import LIMIT
from torchmbd.study.record.evaluations import Evaluations
from torchmbd.study.record.paths import evaluations_file, problem_key
from torchmbd.study.report.progress import Beginning
from torchmbd.study.report.start_values import Value, print_start_values, start_values, worst_share
from torchmbd.study.settings import StudySettings
from torchmbd.summary import plural

_TRACKING = 6.0  # s: pictures are drawn, MLflow is loaded, its store opened, runs and files are written
_PATIENCE = 60.0  # s for a batch, and for the errors of the start design
_ONCE = {True: "loading, verification, pictures, MLflow", False: "loading, pictures, MLflow"}
_FINER = 7.0  # motions of the steps of the problem that its errors take: the same, of half the steps and a quarter
# Of RobustProblem.
_TOLERANCE_WORDS = {
    "expected": ", mean over the tolerances",
    "worst": ", worst case over the tolerances",
}


@dataclass(frozen=True)
class Estimate:
    """Cost of a study on this machine: simulations, seconds of one batch and of all, peak memory [bytes].

    simulations, seconds  the fewest and the most, if no start ends early
    once       seconds that are spent once: first evaluation, verification, pictures, tracking
    design_seconds  of one design by itself
    gradients  mode of the gradients: "forward", "reverse", "none" of a sweep
    resolved   whether the steps resolve the responses of the start design; True where that is not known
    """

    simulations: tuple[int, int]
    lanes: int
    batch_seconds: float
    seconds: tuple[float, float]
    once: float
    design_seconds: float
    memory: float
    gradients: str
    resolved: bool = True


def estimate(study: StudySettings, problem: Problem) -> Estimate:
    """Evaluate one design twice and a batch, and count the batches of the study."""
    starts = _start_designs(study)
    groups = _group_sizes(study, len(starts))
    starts = np.resize(starts, (max(groups), starts.shape[1]))
    cases = getattr(problem, "simulations", 1)  # of one design
    if study.problem is not problem:  # a robust one, of designs around each
        around = max(1, getattr(study.problem, "simulations", 1) // cases)
        starts, groups = np.repeat(starts, around, axis=0), [around * size for size in groups]
    X = starts[:LANES, : len(problem.names)]
    mode = problem.gradients if study.sweep is None else "none"
    each = (1, 1)
    if study.sweep is None:
        each = effort.simulations(study.problem, study.method, study.max_iterations, study.options)
    begin_stage("evaluating the start design")
    first = _seconds(problem, X[:1], mode)  # with what is done once per process
    alone = first if first > _PATIENCE else _seconds(problem, X[:1], mode)
    count = min(max(1, int(_PATIENCE / alone)) if alone else len(X), len(X))
    begin_stage(f"evaluating {plural(count, 'design')}, gradients: {mode}")
    batch = (alone if count == 1 else _seconds(problem, X[:count], mode)) * len(X) / count
    batches = sum(math.ceil(size / LANES) for size in groups)
    once = max(first - alone, 0.0) + _TRACKING + (_FINER * alone if study.sweep is None else 0.0)
    memory = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    least, most = each
    counts = least * sum(groups) * cases, most * sum(groups) * cases
    seconds = least * batches * batch + once, most * batches * batch + once
    return Estimate(counts, len(X) * cases, batch, seconds, once, alone, memory, mode)


def _seconds(problem: Problem, X: np.ndarray, mode: str) -> float:
    """Return the seconds of an evaluation of designs [lanes, n]."""
    began = time.perf_counter()
    problem.evaluate(X, mode != "none")
    return time.perf_counter() - began


def _group_sizes(study: StudySettings, starts: int) -> list[int]:
    """Return how many searches, or designs of a sweep, run together, group after group."""
    criteria = getattr(study.problem, "criteria", ())
    if not criteria:
        return [starts]
    settings = {key: study.options[key] for key in ("divisions", "everywhere") if key in study.options}
    return group_sizes(len(criteria), starts, **settings)


def _start_designs(study: StudySettings) -> np.ndarray:
    if study.sweep is not None:
        return np.tile(study.problem.start, (len(study.sweep[1]) + 1, 1))
    return study.points


def print_estimate(study: StudySettings, console: Console) -> Estimate | None:
    """Print a summary of a valid study and its cost; return the cost, None if nothing is simulated."""
    problem = study.simulated
    valid = f"{study.name if study.origin is None else study.origin.file} is valid"
    if not isinstance(problem, Problem):
        console.print(f"{valid}: {plural(len(study.columns.names), 'design variable')}", markup=False)
        return None
    goal = ", ".join(study.problem.criteria) if study.front else words(problem.stated_objective)
    others = len(study.problem.criteria) - 1 if study.front else 0
    console.print(
        f"{valid}: {goal}, {plural(len(study.columns.names), 'design variable')}, "
        f"{plural(len(problem.constraints) - others, 'constraint')}"
        + _TOLERANCE_WORDS.get(getattr(study.problem, "kind", ""), "")
        + _over_scenarios(problem),
        markup=False,
        soft_wrap=True,
    )
    with stages_told(Beginning(console).stage):
        _ = problem.steps  # chosen before costs are measured
        cost = estimate(study, problem)
        values, reason = _values_with_errors(problem, cost, others + 1)
    count = 0
    if evaluations_file().exists():
        with contextlib.closing(Evaluations(evaluations_file(), problem_key(problem))) as store:
            count = store.count()
    stored = f"; {count} evaluations of this problem are in the store already" if count else ""
    console.print(
        f"{_simulations_text(study, cost)} in batches of {cost.lanes}, {_duration(cost.batch_seconds)} each: "
        f"{_range(*map(_duration, cost.seconds))} in one process, {_duration(cost.once)} of them once "
        f"({_ONCE[study.sweep is None]}), {cost.memory / 2**30:.1f} GiB{stored}"
        + "; not counted is the search of designs on the steps after that, which may take many times as long"
        * any(study.increments),
        markup=False,
        soft_wrap=True,
    )
    _print_truncation(problem, console)
    _print_assembly(problem, console)
    print_start_values(values, console)
    share = worst_share(values) if isinstance(values, list) else 0.0
    if line := _steps_line(problem, share, reason):
        console.print(line, markup=False, soft_wrap=True)
    if cost.gradients != "none":
        console.print(f"gradients: {cost.gradients} mode, chosen by an estimate", markup=False, soft_wrap=True)
    return replace(cost, resolved=not math.isnan(share))


def _simulations_text(study: StudySettings, cost: Estimate) -> str:
    """Return `60 to 160 simulations, if no start ends early, ...` and what limits them; `10 simulations` of a sweep."""
    count = f"{_range(*map(str, cost.simulations))} simulations"
    if study.sweep is not None:
        return count
    if study.options.get("max_analyses") is not None:
        return f"at most {cost.simulations[1]} simulations (max_analyses)"
    return f"{count}, if no start ends early (limit: max_analyses),"


def _range(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"


def _values_with_errors(problem: Problem, cost: Estimate, criteria: int) -> tuple[list[Value] | str, str]:
    """Return the responses of the start design with their errors, as far as there is time, and why there are none."""
    values, took = start_values(problem, criteria), _FINER * cost.design_seconds
    if isinstance(values, str):
        return values, values
    if took > _PATIENCE:
        return (
            values,
            f"its errors are not estimated, which takes {_duration(took)}. Try: problem.errors(...) in Python",
        )
    begin_stage("simulating the start design with half the steps, and with more modes")
    try:
        return start_values(problem, criteria, problem.errors(problem.start, mesh=False)), ""
    except MbdError as error:
        return values, f"its errors are not estimated: {error}"


def _steps_line(problem: Problem, share: float, reason: str) -> str:
    """Return how many steps a motion has, and what they are worth; `share`, `reason` as their two functions make them."""
    how = "chosen for the start design" if problem.chooses_steps else "as given"
    text = f"steps: by the method; {reason}" if problem.steps is None else f"steps: {problem.steps}, {how}"
    if reason:
        return f"{text}; {reason}"
    if share <= LIMIT:
        return f"{text}; the largest error at the start design is {100.0 * share:.1g} %"
    accuracy = "do not resolve it" if math.isnan(share) else f"leave an error of {100.0 * share:.2g} %"
    return f"warning: {text}, {accuracy}. Try: {advice(problem, share / LIMIT)}"


def _over_scenarios(problem: Problem) -> str:
    """Return `, worst of 20 scenarios`, "" for a problem without scenarios."""
    if not isinstance(problem, Scenarios):
        return ""
    return f", {'worst' if problem.peaks else 'mean'} of {plural(len(problem.scenarios), 'scenario')}"


def _print_truncation(problem: Problem, console: Console) -> None:
    """Print the error of the retained modes, if the system checks it."""
    limit = problem.system.truncation
    truncation = None if limit is None else static_truncation(problem.system)
    if limit is None or truncation is None:
        return
    small = f"make joints and forces {100 * max(truncation.share, 0.0):.1g} % too stiff at most"
    text = f"retained modes: {small}" if truncation.share <= limit else f"warning: {truncation}"
    console.print(text, markup=False, soft_wrap=True)


def _duration(seconds: float) -> str:
    """Write a time in a fitting unit: `12 s`, `3.4 h`."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.2g} s"


def _print_assembly(problem: Problem, console: Console) -> None:
    """Print the joints that are open where the model puts its bodies, what the start moves, and redundant rows of joints."""
    dynamics = problem.system.dynamics()
    with torch.no_grad():
        closing = dynamics.initial.closing(dynamics)
    marked = "warning: " * closing.far
    lines = [f"{marked}open where the bodies were put: joint {joint}" for joint in closing.joints]
    lines += [f"{marked}to close the joints the start moves {body}" for body in closing.bodies]
    if dynamics.redundant:
        lines.append(f"over-constraint: {', '.join(dynamics.redundant)} follow from other rows of joints")
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)
