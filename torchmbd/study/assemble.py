"""Make a Study from a valid experiment file: its problem, tolerances, start designs and sweep.

Checked in tests/study/test_tolerances.py, tests/study/test_discrete_polish.py, tests/study/test_run.py.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchmbd.design import Constraint, Problem, Tradeoff
from torchmbd.design.response_spec import measure_of
from torchmbd.design.scenarios import SYSTEM, Scenarios
from torchmbd.design.space import CONSTANT
from torchmbd.multibody.system import System
from torchmbd.optimization import RobustProblem, Starts, given, latin_hypercube, sobol
from torchmbd.study.check import design_vector, entry_labels
from torchmbd.study.config_index import QUESTION_MISSING, question
from torchmbd.study.model import find_phases, find_response, scenario_systems
from torchmbd.study.schema import UNITS, Combine, Optimizer, StudyFile
from torchmbd.study.settings import Origin, StudySettings

S = TypeVar("S", bound=StudySettings)


def study_of(
    data: StudyFile, system: System, file: Path, overrides: tuple[str, ...] = (), kind: type[S] = StudySettings
) -> S:
    """Return the study of a valid file, an object of the class `kind`.

    system     built by the model of the file
    file       path of the file
    overrides  of the command line
    """
    problem, own = _problem(data, system, file.absolute().parent), entry_labels(data.design, system, data.links)
    optimizer = data.optimizer or Optimizer()
    tolerance = _entries(data, system, "tolerance", len(problem.names))
    steps = dict(zip(problem.names, _entries(data, system, "step", len(problem.names)), strict=True))
    asked = question(file) if file.is_file() else QUESTION_MISSING
    searched: Any = problem
    if tolerance.any() and isinstance(problem, Problem):  # a Tradeoff has none, see StudyFile
        searched = RobustProblem(problem, tolerance, data.robust or "expected")
    return kind(
        searched,
        _starts(data, system, problem),
        optimizer.name,
        file.stem,
        max_iterations=optimizer.max_iterations,
        increments={name: float(step) for name, step in steps.items() if step},
        sweep=_sweep(data),
        question="" if asked == QUESTION_MISSING else asked,
        units={name: data.design[name].unit for name in {label.rpartition("[")[0]: None for label in own}},
        experiment=data.tracking.experiment,
        uri=data.tracking.uri,
        origin=Origin(file, overrides, data),
        **optimizer.options,
    )


def _problem(data: StudyFile, system: System, folder: Path) -> Problem | Tradeoff:
    start, lower, upper = (_entries(data, system, key) for key in ("start", "lower", "upper"))
    simulate = data.simulate
    read = partial(measure_of, find=partial(find_response, folder=folder))
    kind, more = Problem, dict(simulate.options)
    asked: Any = None if data.minimize is None else read(data.minimize)
    if data.tradeoff is not None:
        kind, asked = Tradeoff, {name: read(spec) for name, spec in data.tradeoff.items()}
    if data.scenarios is not None:
        kind, combine = Scenarios, data.combine or Combine()
        systems = scenario_systems(data.model, data.options, data.scenarios, folder)
        named: dict[str, Any] = {s.name or f"scenario {k + 1}": dict(s.settings) for k, s in enumerate(data.scenarios)}
        for settings, own in zip(named.values(), systems, strict=True):
            settings |= {} if own is None else {SYSTEM: own}
        more |= {"scenarios": named, "weights": [s.weight for s in data.scenarios], **combine.model_dump()}
    return kind(
        system,
        duration=simulate.duration,
        minimize=asked,
        **({} if data.maximize is None else {"maximize": read(data.maximize)}),
        subject_to=[Constraint(read(c.measure), c.si(c.limit), c.kind, c.si(c.scale)) for c in data.subject_to],
        bounds=(lower, upper),
        variables=list(data.design),
        start=start,
        links=_links(data),
        method=simulate.method,
        steps=simulate.steps,
        tolerance=simulate.tolerance,
        phases=None if simulate.phases is None else find_phases(simulate.phases, folder),
        gradients=simulate.gradients,
        backend=simulate.backend,
        motion_start=simulate.start,
        **more,
    )


def _factor(data: StudyFile, entry: str) -> float:
    """Return the factor from the unit of the file to SI for an entry of the design vector."""
    return UNITS[data.design[entry.rpartition("[")[0]].unit]


def _factors(data: StudyFile, system: System) -> np.ndarray:
    return np.array([_factor(data, label) for label in entry_labels(data.design, system, data.links)])


def _links(data: StudyFile) -> dict[str, dict[str, float]]:
    """Return the links in SI; in the file, factors relate numbers in their units, constants are in the follower's unit."""
    return {
        entry: {
            name: x * _factor(data, entry) / (1.0 if name == CONSTANT else _factor(data, name))
            for name, x in leaders.items()
        }
        for entry, leaders in data.links.items()
    }


def _entries(data: StudyFile, system: System, key: str, count: int | None = None) -> np.ndarray:
    """Return "start", "lower", ... of the design vector [SI], with zeros for extra variables up to `count` entries."""
    entries = design_vector(data.design, system, key, data.links) * _factors(data, system)
    return entries if count is None else np.append(entries, np.zeros(count - entries.size))


def _starts(data: StudyFile, system: System, problem: Problem | Tradeoff) -> Starts | None:
    """Return the rule of the start designs; all have the extra variable of the initial design."""
    starts = data.starts
    if starts is None or starts.sampler == "none":
        return None
    if starts.sampler == "given":
        factors = _factors(data, system)
        points: list[Any] = [np.append(np.array(x) * factors, problem.start[len(x) :]) for x in starts.points or ()]
        return given([problem.start, *points] if starts.include_initial else points)
    sample = {"sobol": sobol, "latin_hypercube": latin_hypercube}[starts.sampler]
    return sample(starts.count or 1, starts.seed, include_initial=starts.include_initial)


def _sweep(data: StudyFile) -> dict[str, tuple[float, float, int]] | None:
    if data.sweep is None:
        return None
    [(name, span)] = data.sweep.items()
    factor = UNITS[data.design[name.rpartition("[")[0] if name.endswith("]") else name].unit]
    return {name: (span.first * factor, span.last * factor, span.count)}
