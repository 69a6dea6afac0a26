"""From a plan to what runs: the Problem of torchmbd.design and the start designs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import numpy as np

from torchmbd.design import History, Measure, Problem
from torchmbd.design.responses import COMBINATORS, RESPONSES
from torchmbd.experiment.check import vector
from torchmbd.experiment.load import Plan
from torchmbd.optimizers import Starts, given, latin_hypercube, sobol


def problem_of(plan: Plan) -> Problem:
    """Build the problem of a plan."""
    study, columns = plan.study, plan.columns
    start, lower, upper = (columns.si(vector(study.design, plan.system, key)) for key in ("start", "lower", "upper"))
    return Problem(
        plan.system,
        duration=study.simulate.duration,
        minimize=measure(study.minimize),
        subject_to=[measure(c.measure) <= c.at_most for c in study.subject_to],
        bounds=(lower, upper),
        variables=list(study.design),
        start=start,
        method=study.simulate.method,
        steps=study.simulate.steps,
        **study.simulate.options,
    )


def measure(spec: Mapping[str, Mapping[str, str]]) -> Measure:
    """Build a response from `{integral: {strain_energy: rod}}`."""
    [(combinator, inner)] = spec.items()
    [(response, body)] = inner.items()
    build = cast(Callable[..., Measure], COMBINATORS[combinator])
    history = cast(Callable[..., History], RESPONSES[response])
    return build(history(body))


def starts_of(plan: Plan, start: np.ndarray) -> Starts:
    """Return the recipe of the start designs; `start` is the initial design [SI]."""
    starts = plan.study.starts
    if starts is None or starts.sampler == "none":
        return given([start])
    if starts.sampler == "given":
        points = [plan.columns.si(np.array(point)) for point in starts.points or ()]
        return given([start, *points] if starts.include_initial else points)
    sample = {"sobol": sobol, "latin_hypercube": latin_hypercube}[starts.sampler]
    return sample(starts.count or 1, starts.seed, include_initial=starts.include_initial)
