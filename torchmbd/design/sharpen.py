"""Aggregates as sharp as they must be: optimize, compare them with their largest rows, raise the sharpness, optimize on.

A soft aggregate leaves a margin that costs some of the optimum; one that is sharp at once is badly conditioned. The sharpness
grows by as much as the aggregates of the last result lie too far above their largest rows, at most tenfold.

Source: Poon and Martins, Structural and Multidisciplinary Optimization 34 (2007) 61-73, whose constants adapt as well.
Checked in tests/design/test_aggregate.py.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from torchmbd.design.aggregate import Aggregate
from torchmbd.design.problem import Problem
from torchmbd.design.response import Measure
from torchmbd.design.scenarios import Scenarios
from torchmbd.errors import InputError
from torchmbd.optimization import OptimizationResult, optimize
from torchmbd.optimization.optimizer import require_count, require_range

FASTEST = 10.0  # the sharpness grows by no more between two optimizations


class Round(NamedTuple):
    """One optimization of `sharpen`.

    factor      on the sharpness that was given
    result      how it ended
    aggregates  values at its design, one for each aggregate, in their units
    largest     the largest rows there, exactly
    """

    factor: float
    result: OptimizationResult
    aggregates: np.ndarray
    largest: np.ndarray

    @property
    def gap(self) -> float:
        """How far the aggregates lie above the largest rows, of these; the largest."""
        return float(np.max((self.aggregates - self.largest) / np.maximum(np.abs(self.largest), np.finfo(float).tiny)))


def sharpen(
    problem: Problem, method: str = "mma", tolerance: float = 0.01, max_rounds: int = 6, **options: Any
) -> list[Round]:
    """Optimize with aggregates as sharp as they must be, and no sharper: rounds, the last of them the result.

    problem     whose objective or constraints hold an Aggregate
    method      of `optimize`
    tolerance   how far aggregates may lie above their largest rows, of these [-]
    max_rounds  optimizations at most; `rounds[-1].gap` tells what was reached
    options     of `optimize`, such as max_iterations of every round

    >>> height = mbd.AtTimes(mbd.Displacement("arm", "z", node="right"), count=20)
    >>> problem = mbd.Problem(
    ...     mbd.examples.arm(), 0.05, mbd.Aggregate(height, "p_norm", 8.0), steps=20, bounds=mbd.deg([-90, 90])
    ... )
    >>> rounds = mbd.sharpen(problem, tolerance=0.05, max_iterations=2)
    >>> rounds[-1].gap < 0.05
    True
    """
    if not isinstance(problem, Problem):
        raise InputError(f"problem is {problem!r}; allowed: a Problem")
    if not _aggregates(problem):
        raise InputError("problem has no Aggregate; allowed: one in the objective or in a constraint")
    require_range("tolerance", tolerance, 0.0, 1.0)
    require_count("max_rounds", max_rounds, 1, 100)
    start, factor, rounds = options.pop("start", None), 1.0, []
    while True:
        sharper = sharpened(problem, factor)
        result = optimize(sharper, method, start, **options)
        rounds.append(_round(sharper, factor, result))
        if rounds[-1].gap <= tolerance or len(rounds) == max_rounds:
            return rounds
        start, factor = result.x, factor * min(FASTEST, max(2.0, rounds[-1].gap / tolerance))


def _round(problem: Problem, factor: float, result: OptimizationResult) -> Round:
    """What the aggregates are at a result: of scenarios the largest."""
    x = result.x
    motions = problem.motions_by_system(x) if isinstance(problem, Scenarios) else [problem.motion(x)]
    values = np.array(
        [
            [
                float(torch.cat([f(motion.require_ok()) for motion in motions]).max())
                for f in (aggregate, aggregate.largest)
            ]
            for aggregate in _aggregates(problem)
        ]
    )
    return Round(factor, result, values[:, 0], values[:, 1])


def sharpened(problem: Problem, factor: float) -> Problem:
    """The same problem with `factor` times as sharp aggregates."""

    def change(measure: Measure) -> Measure:
        if isinstance(measure, Aggregate):
            return replace(measure, sharpness=measure.sharpness * factor)
        return measure.mapped(change)

    result = copy.copy(problem)
    result.__dict__.pop("reference", None)
    result.stated_objective, result.objective = change(problem.stated_objective), change(problem.objective)
    result.constraints = [replace(c, measure=change(c.measure)) for c in problem.constraints]
    return result


def _aggregates(problem: Problem) -> list[Aggregate]:
    """All of them, the objective's first."""

    def of(measure: Measure) -> list[Aggregate]:
        own = [measure] if isinstance(measure, Aggregate) else []
        return own + [found for operand in measure.operands for found in of(operand)]

    return [found for m in (problem.stated_objective, *(c.measure for c in problem.constraints)) for found in of(m)]
