"""Make a Study from a valid experiment file: its problem, tolerances, start designs and sweep.

Checked in tests/study/test_tolerances.py, tests/study/test_discrete_polish.py, tests/study/test_run.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.design import Constraint, Problem, Tradeoff
from torchmbd.design.response_spec import measure_of
from torchmbd.design.scenario_settings import SYSTEM
from torchmbd.design.scenarios import Scenarios
from torchmbd.errors import InputError
from torchmbd.multibody.system import System
from torchmbd.optimization import RobustProblem, Starts, latin_hypercube, sobol
from torchmbd.study.file import schema
from torchmbd.study.file.config_index import question
from torchmbd.study.file.model import find_phases, find_response, scenario_systems
from torchmbd.study.file.parameter_values import set_parameters
from torchmbd.study.file.schema import UNITS, Bounded, Combine, Optimizer, Range, StudyFile
from torchmbd.study.settings import Origin, StudySettings


def study_of(data: StudyFile, system: System, file: Path, overrides: tuple[str, ...] = ()) -> StudySettings:
    """Return the study of a valid file; InputError for what a constructor refuses.

    system     built by the model of the file
    file       path of the file
    overrides  of the command line
    """
    problem = _problem(data, system, file.absolute().parent)
    space = problem.problem.space if isinstance(problem, Tradeoff) else problem.space
    optimizer = data.optimizer or Optimizer()
    tolerance, steps = (
        space.vector(key, in_si(data.design, key), np.zeros(len(space.names))) for key in ("tolerance", "step")
    )
    for name in {label.rpartition("[")[0]: None for label in space.names}:
        if data.design[name].lower is None or data.design[name].upper is None:
            raise InputError(
                name,
                allowed="must have lower and upper, because some entries are not determined by links",
                state="does not have both bounds",
            )
    searched: Any = problem
    if tolerance.any() and isinstance(problem, Problem):  # a Tradeoff has none, see StudyFile
        extra = np.zeros(len(problem.names) - len(space.names))
        searched = RobustProblem(problem, np.append(tolerance, extra), data.robust or "expected")
    return StudySettings(
        searched,
        starts_of(data.starts, data.design, space.names, problem.start),
        optimizer.name,
        file.stem,
        max_iterations=optimizer.max_iterations,
        increments={name: float(step) for name, step in zip(space.names, steps, strict=True) if step},
        sweep=None if data.sweep is None else sweep_in_si(data.design, data.sweep),
        question=question(file),
        units={name: data.design[name].unit for name in {label.rpartition("[")[0]: None for label in space.names}},
        experiment=data.tracking.experiment,
        uri=data.tracking.uri,
        origin=Origin(file, overrides, data),
        **optimizer.options,
    )


def _problem(data: StudyFile, system: System, folder: Path) -> Problem | Tradeoff:
    simulate = data.simulate
    read = partial(measure_of, find=partial(find_response, folder=folder))
    kind, more = Problem, dict(simulate.options)
    objective: Any = None if data.minimize is None else read(data.minimize)
    if data.tradeoff is not None:
        kind, objective = Tradeoff, {name: read(spec) for name, spec in data.tradeoff.items()}
    if data.scenarios is not None:
        kind, combine = Scenarios, data.combine or Combine()
        change = partial(set_parameters, values=data.parameters)
        systems = scenario_systems(data.model, data.options, data.scenarios, folder, change)
        named: dict[str, Any] = {s.name or f"scenario {k + 1}": dict(s.settings) for k, s in enumerate(data.scenarios)}
        for settings, variant in zip(named.values(), systems, strict=True):
            settings |= {} if variant is None else {SYSTEM: variant}
        more |= {"scenarios": named, "weights": [s.weight for s in data.scenarios], **combine.model_dump()}
    return kind(
        system,
        duration=simulate.duration,
        minimize=objective,
        **({} if data.maximize is None else {"maximize": read(data.maximize)}),
        subject_to=[Constraint(read(c.measure), c.si(c.limit), c.kind, c.si(c.scale)) for c in data.subject_to],
        bounds=(in_si(data.design, "lower"), in_si(data.design, "upper")),
        variables=list(data.design),
        start=in_si(data.design, "start"),
        links=links_in_si(data.design, data.links),
        method=simulate.method,
        steps=simulate.steps,
        tolerance=simulate.tolerance,
        phases=None if simulate.phases is None else find_phases(simulate.phases, folder),
        gradients=simulate.gradients,
        backend=simulate.backend,
        motion_start=simulate.start,
        **more,
    )


def in_si(design: Mapping[str, Bounded], key: str) -> dict[str, np.ndarray]:
    """Return parameter -> "start", "lower", "upper", "tolerance" or "step" [SI], of those that have it."""
    numbers = {name: getattr(variable, key) for name, variable in design.items()}
    return {name: np.multiply(UNITS[design[name].unit], x) for name, x in numbers.items() if x is not None}


def factor_of(design: Mapping[str, Bounded], entry: str) -> float:
    """Return the factor from the unit of the file to SI of an entry, `rod.laminate.angles[0]`; 1 of what is none."""
    name = entry.rpartition("[")[0] or entry
    return UNITS[design[name].unit] if name in design else 1.0


def links_in_si(design: Mapping[str, Bounded], links: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return the links in SI; in the file, factors relate numbers in their units, constants are in the follower's unit."""
    return {
        follower: {leader: x * factor_of(design, follower) / factor_of(design, leader) for leader, x in leaders.items()}
        for follower, leaders in links.items()
    }


def point_in_si(design: Mapping[str, Bounded], names: Sequence[str], point: Sequence[float]) -> list[float]:
    """Return a start point [SI], in its length, which may be wrong."""
    factors = [factor_of(design, name) for name in names] + [1.0] * len(point)
    return [factor * x for factor, x in zip(factors, point, strict=False)]


def starts_of(
    starts: schema.Starts | None, design: Mapping[str, Bounded], names: Sequence[str], initial: np.ndarray
) -> Starts | list[Any] | None:
    """Return where searches start, None: from the initial design alone; `names`: of the entries of a point."""
    if starts is None or starts.sampler == "none":
        return None
    if starts.sampler == "given":
        points = [point_in_si(design, names, x) for x in starts.points or ()]
        return [initial, *points] if starts.include_initial else points
    sample = {"sobol": sobol, "latin_hypercube": latin_hypercube}[starts.sampler]
    return sample(starts.count or 1, starts.seed, include_initial=starts.include_initial)


def sweep_in_si(design: Mapping[str, Bounded], sweep: Mapping[str, Range]) -> dict[str, tuple[float, float, int]]:
    """Return entry -> (first value, last value [SI], count)."""
    factors = {name: factor_of(design, name) for name in sweep}
    return {name: (span.first * factors[name], span.last * factors[name], span.count) for name, span in sweep.items()}
