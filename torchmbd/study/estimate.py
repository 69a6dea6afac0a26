"""Estimate of the cost of a study, from two short motions of its first batch: `torchmbd check`.

    seconds = once + batches (structure + steps * step)   once: loading and compiling code, pictures, MLflow. Motions of two
                                                          lengths, with responses and gradients, give structure and step
    memory  = base + lanes * (bytes of a motion) * 3      the motion, its work arrays, the responses

Gradients are measured in forward and in reverse mode, where the method has both; the study uses the mode that the problem
has chosen by an estimate (design/gradient_mode.py).

Simulations of a sweep: its points. Of an optimization: 1.5 for each iteration of each start, as in the shipped studies, and no
start ends early. Of a front: the same for each anchor from each start and from each anchor, for each point, and once more for
each. For methods that choose their steps, a unit of time takes the place of a step. Pictures: one is drawn, its time counts
for each of their axes. Times are those of this machine without other load.
Checked in tests/study/test_estimate.py.
"""

from __future__ import annotations

import contextlib
import math
import resource
import tempfile
import time
import warnings
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from torchmbd.design import Problem
from torchmbd.design.differentiate import differentiate
from torchmbd.design.ply_failure import PlyFailure
from torchmbd.design.scenarios import Scenarios
from torchmbd.design.verification import advice
from torchmbd.design.words import words
from torchmbd.diagnosis.truncation import static_truncation
from torchmbd.errors import MbdError
from torchmbd.integrate import Trajectory
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
from torchmbd.viz.figures import convergence, save
from torchmbd.viz.panels import histories_of, panels_of

_PER_ITERATION = 1.7  # simulations: of the default method in 20 searches of `benchmark methods`
_SHARES = (0.02, 0.06)  # of the motion that are measured
_SINGLE, _KINDS, _AXES_OF_MAP = 3, 2, 4  # pictures of one kind of file, kinds of the others, axes of a map of failure
_FEWEST = 4  # steps
_COPIES = 3.0
_TRIES = 2
_LONG = 5.0  # s of one try: other load matters less, so that it is the only one, and the next one is told
_TRACKING = 4.0  # s: MLflow is loaded, its store opened, runs and files are written
_PATIENCE = 60.0  # s: where a batch takes longer, the start design is not simulated
_FINER = 7.0  # motions of the steps of the problem that its errors take: the same, of half the steps and a quarter
_FASTER = 0.9  # of the time of the mode that is chosen
_OTHER_MODE = {"forward": ("reverse",), "reverse": ("forward",)}
# Of RobustProblem.
_TOLERANCE_WORDS = {
    "expected": ", mean over the tolerances",
    "worst": ", worst case over the tolerances",
}


@dataclass(frozen=True)
class Estimate:
    """Cost of a study on this machine: simulations at most, seconds of one batch and of all, peak memory [bytes].

    once       seconds that are spent once: first evaluation, pictures, tracking
    resolved   whether the steps resolve the responses of the start design; True where that is not known
    gradients  mode of the gradients: "forward", "reverse", "none" of a sweep
    others     other mode -> seconds of one batch
    """

    simulations: int
    lanes: int
    batch_seconds: float
    seconds: float
    once: float
    memory: float
    gradients: str
    others: dict[str, float]
    resolved: bool = True


def estimate(study: StudySettings, problem: Problem) -> Estimate:
    """Measure two short motions with their responses, and extrapolate."""
    starts = _start_designs(study)
    groups = _group_sizes(study, len(starts))
    starts = np.resize(starts, (max(groups), starts.shape[1]))
    cases = getattr(problem, "simulations", 1)  # of one design
    if study.problem is not problem:  # a robust one, of designs around each
        around = max(1, getattr(study.problem, "simulations", 1) // cases)
        starts, groups = np.repeat(starts, around, axis=0), [around * size for size in groups]
    X = starts[:LANES, : len(problem.names)]
    mode = problem.gradients if study.sweep is None else "none"
    begin_stage(f"measuring the beginning of {plural(len(X) * cases, 'motion')}, gradients: {mode}")
    each = math.ceil(_PER_ITERATION * study.max_iterations) if study.sweep is None else 1
    first, batch, size = _measure_batch(problem, X, mode)
    others = {}
    for other in _OTHER_MODE.get(mode, ()):
        begin_stage(f"measuring the same, gradients: {other}")
        with contextlib.suppress(MbdError):  # the method or the system has no such mode
            others[other] = _measure_batch(problem, X, other)[1]
    batches = each * sum(math.ceil(size / LANES) for size in groups)
    base = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    drawn = study.sweep is None and len(groups) == 1
    once = first + _TRACKING + (batch + _picture_seconds(problem) if drawn else 0.0)  # two motions of pictures
    memory = base + _COPIES * size
    return Estimate(
        each * sum(groups) * cases, len(X) * cases, batch, batches * batch + once, once, memory, mode, others
    )


def _picture_seconds(problem: Problem) -> float:
    """Return the seconds of all pictures of a study, from those of one."""
    seconds = []
    with tempfile.TemporaryDirectory(prefix="torchmbd-") as folder:
        for k in range(2):  # the first one loads matplotlib
            began = time.perf_counter()
            save(convergence({"start": [2.0, 1.0]}, {"start": [0.0, 0.0]}), Path(folder) / f"{k}.png")
            seconds.append(time.perf_counter() - began)
    panels = panels_of(problem)
    maps = sum(isinstance(panel.history, PlyFailure) for panel in panels)
    each = len(panels) + 1 + len(problem.constraints) + _AXES_OF_MAP * maps
    return seconds[0] + seconds[1] * (_SINGLE + _KINDS * each)


def _measure_batch(problem: Problem, X: np.ndarray, mode: str) -> tuple[float, float, float]:
    """Return seconds that are spent once, seconds of a batch of designs [lanes, n], and its bytes."""
    times, size = [], 0.0
    shares = _shares(problem.steps)
    began = time.perf_counter()
    _simulate_beginning(problem, X[:1], mode, shares[0])  # includes what is done once per process
    once = time.perf_counter() - began
    for share in shares:
        tries: list[float] = []
        if max([once, *(seconds for _, seconds in times)]) > _LONG:
            begin_stage(f"measuring {share:.0%} of the motions of {plural(len(X), 'design')}, gradients: {mode}")
        # The fastest: the difference of two lengths is multiplied by up to 25, with its errors.
        while len(tries) < _TRIES and not (tries and tries[0] > _LONG):
            began = _clocks()
            size = _simulate_beginning(problem, X, mode, share) / share
            tries.append(min(now - then for now, then in zip(_clocks(), began, strict=True)))
        times.append((share, min(tries)))
    (a, fast), (b, slow) = times[0], times[-1]
    rate = max((slow - fast) / (b - a), 0.0) if b > a else fast / a
    return once, max(fast - rate * a, 0.0) + rate, size


def _group_sizes(study: StudySettings, starts: int) -> list[int]:
    """Return how many searches, or designs of a sweep, run together, group after group."""
    criteria = getattr(study.problem, "criteria", ())
    if not criteria:
        return [starts]
    settings = {key: study.options[key] for key in ("divisions", "everywhere") if key in study.options}
    return group_sizes(len(criteria), starts, **settings)


def _clocks() -> tuple[float, float]:
    """Return wall time and processor time [s]: the first includes other load of the machine, the second all threads."""
    return time.perf_counter(), time.process_time()


def _start_designs(study: StudySettings) -> np.ndarray:
    if study.sweep is not None:
        return np.tile(study.problem.start, (len(study.sweep[1]) + 1, 1))
    return study.points


def _shares(steps: int | None) -> list[float]:
    """Return the two shares of the motion that are simulated; a motion of few steps is cut at whole steps."""
    if steps is None:
        return list(_SHARES)
    first = max(1, min(max(_FEWEST, round(_SHARES[0] * steps)), steps // 2))
    return [first / steps, min(3 * first, steps) / steps]


def _simulate_beginning(problem: Problem, X: np.ndarray, mode: str, share: float) -> float:
    """Simulate the beginning of the motions of all scenarios with their responses; return the bytes of the motions."""
    steps, size = problem.steps, 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the accuracy of a few steps
        for simulation, designs in problem.cases(X):
            part = simulation.beginning(share * problem.duration, None if steps is None else round(share * steps))
            motion = part(designs, mode, problem.space.variables)
            differentiate(partial(_response_rows, problem), motion)
            size += _motion_bytes(motion)
    return size


def _response_rows(problem: Problem, motion: Trajectory) -> Tensor:
    """Return numbers [lanes, rows] at the cost of the responses: sums of their histories, as windows may begin later."""
    rows = []
    for measure in (problem.objective, *(constraint.measure for constraint in problem.constraints)):
        histories = [history for history, _ in histories_of(measure)]
        sums = [history.values(motion).sum(-1)[:, None].expand(-1, measure.rows) for history in histories]
        rows += sums or [measure.value(motion).reshape(motion.lanes, -1)]
    return torch.cat(rows, 1)


def _motion_bytes(motion: Trajectory) -> float:
    """Return the bytes of coordinates, rates and accelerations of a motion with their tangents or cotangents."""
    numbers = sum(x.numel() for x in (motion.q, motion.v, motion.a))
    copies = {"forward": 1 + len(motion.parameters), "reverse": 2}.get(motion.stats["gradients"], 1)
    return 8.0 * numbers * copies


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
        f"at most about {cost.simulations} simulations in batches of {cost.lanes}, {_duration(cost.batch_seconds)} each: "
        f"{_duration(cost.seconds)} in one process, {_duration(cost.once)} of them once (loading, pictures, MLflow), "
        f"{cost.memory / 2**30:.1f} GiB{stored}"
        + "; not counted is the search of designs on the steps after that, which may take many times as long"
        * any(study.increments),
        markup=False,
        soft_wrap=True,
    )
    _print_truncation(problem, console)
    _print_assembly(problem, console)
    if values is not None:
        print_start_values(values, console)
    share = worst_share(values) if isinstance(values, list) else 0.0
    if line := _steps_line(problem, share, reason):
        console.print(line, markup=False, soft_wrap=True)
    if cost.gradients != "none":
        console.print(f"gradients: {_modes_text(cost)}", markup=False, soft_wrap=True)
    return replace(cost, resolved=not math.isnan(share))


def _values_with_errors(problem: Problem, cost: Estimate, criteria: int) -> tuple[list[Value] | str | None, str]:
    """Return the responses of the start design with their errors, as far as there is time, and why there are none."""
    if cost.batch_seconds >= _PATIENCE:
        return None, f"the start design is not simulated, as a batch takes {_duration(cost.batch_seconds)}"
    begin_stage("simulating the start design")
    began = time.perf_counter()
    values = start_values(problem, criteria)
    took = _FINER * (time.perf_counter() - began)
    if isinstance(values, str):
        return values, values
    if took > _PATIENCE:
        return (
            values,
            f"its errors are not estimated, which takes {_duration(took)}; allowed: problem.errors(...) in Python",
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
    return f"warning: {text}, {accuracy}; allowed: {advice(problem, share / LIMIT)}"


def _modes_text(cost: Estimate) -> str:
    """Return the modes of gradients with their times, and which one to ask for where another is faster."""
    text = f"{cost.gradients} mode, chosen by an estimate, {_duration(cost.batch_seconds)} a batch"
    text += "".join(f"; {other} mode {_duration(seconds)}" for other, seconds in cost.others.items())
    mode = min(cost.others, key=lambda other: cost.others[other], default=None)
    if mode is None or not cost.others[mode] < _FASTER * cost.batch_seconds:
        return text
    return f"{text}, which is faster: simulate: {{gradients: {mode}}}"


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
