"""From a plan to what runs: the Problem of torchmbd.design, what optimizers see of it, and the start designs.

Checked in tests/study/test_tolerances.py, tests/study/test_discrete_polish.py, tests/study/test_run.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchmbd.design import Constraint, Problem
from torchmbd.design.problem import BOUND
from torchmbd.design.response_spec import measure_of
from torchmbd.errors import InputError
from torchmbd.optimization import RobustProblem, Starts, given, latin_hypercube, sobol
from torchmbd.optimization.discrete.grid import Grid
from torchmbd.study.check import vector
from torchmbd.study.load import Plan


def problem_of(plan: Plan) -> Problem:
    """Build the problem of a plan."""
    study, columns = plan.study, plan.columns
    start, lower, upper = (vector(study.design, plan.system, key) for key in ("start", "lower", "upper"))
    factors = columns.factors[: start.size]  # without the extra variable
    return Problem(
        plan.system,
        duration=study.simulate.duration,
        minimize=measure_of(study.minimize),
        subject_to=[Constraint(measure_of(c.measure), c.si(c.limit), c.kind, c.si(c.scale)) for c in study.subject_to],
        bounds=(lower * factors, upper * factors),
        variables=list(study.design),
        start=start * factors,
        method=study.simulate.method,
        steps=study.simulate.steps,
        phases=plan.phases,
        gradients=study.simulate.gradients,
        backend=study.simulate.backend,
        motion_start=study.simulate.start,
        **study.simulate.options,
    )


def tolerances(plan: Plan) -> np.ndarray:
    """Return how far every design variable may be off [SI], zero for what is made exactly."""
    return _all(plan, "tolerance")


def increments(plan: Plan) -> list[float | None]:
    """Return the step of every design variable [SI]; None where it takes any value."""
    return [float(step) or None for step in _all(plan, "step")]


def _all(plan: Plan, key: str) -> np.ndarray:
    given = vector(plan.study.design, plan.system, key)
    return np.append(given, np.zeros(len(plan.columns.names) - given.size)) * plan.columns.factors


def sought(plan: Plan, problem: Any) -> Any:
    """Return what optimizers see: the problem, or its mean over the tolerances.

    Raises InputError where it has none, where no step lies between the bounds, and for steps of a min-max problem.
    """
    own, steps = tolerances(plan), increments(plan)
    target = RobustProblem(problem, own) if own.any() else problem
    if any(steps) and plan.columns.labels[-1] == BOUND:
        raise InputError("design has a step, and the objective several rows; allowed: one number, such as max")
    if any(steps):
        Grid(target, steps, target.lower, target.upper, target.period)
    return target


def starts_of(plan: Plan, start: np.ndarray) -> Starts:
    """Return the recipe of the start designs; `start` is the initial design [SI], whose extra variable all points share."""
    starts = plan.study.starts
    if starts is None or starts.sampler == "none":
        return given([start])
    if starts.sampler == "given":
        points = [plan.columns.si(np.append(point, start[len(point) :])) for point in starts.points or ()]
        return given([start, *points] if starts.include_initial else points)
    sample = {"sobol": sobol, "latin_hypercube": latin_hypercube}[starts.sampler]
    return sample(starts.count or 1, starts.seed, include_initial=starts.include_initial)
