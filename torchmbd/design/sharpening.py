"""Optimizations with growing sharpness of aggregates (aggregate.py): each begins where the one before it ended.

The sharpness grows by the ratio of the gap between aggregates and largest rows to the tolerance, at most tenfold.
Source: Poon and Martins, Structural and Multidisciplinary Optimization 34 (2007) 61-73, whose constants adapt as well.
Checked in tests/design/test_aggregate.py.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.aggregate import Aggregate
from torchmbd.design.problem import Problem
from torchmbd.design.response import Measure
from torchmbd.design.scenarios import Scenarios
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.optimization import OptimizationResult, optimize
from torchmbd.optimization.optimizer import require_count, require_range

FASTEST = 10.0  # the sharpness grows by no more between two optimizations


class Round(NamedTuple):
    """One optimization of `sharpen`.

    factor      by which the sharpness of the problem is multiplied
    result      of the optimization
    aggregates  values at the optimum, one for each aggregate, in their units
    largest     the exact largest rows of the aggregates there
    sizes       of the aggregates there (`Measure.size`)
    """

    factor: float
    result: OptimizationResult
    aggregates: np.ndarray
    largest: np.ndarray
    sizes: np.ndarray

    @property
    def gap(self) -> float:
        """The largest difference of an aggregate from its largest row, a share of its size."""
        return float(np.max((self.aggregates - self.largest) / np.maximum(self.sizes, np.finfo(float).tiny)))


def sharpen(
    problem: Problem, method: str = "mma", tolerance: float = 0.01, max_rounds: int = 6, **options: Any
) -> list[Round]:
    """Optimize several times with increasing sharpness of the aggregates. Return all rounds; the last round has the result.

    problem     whose objective or constraints contain an Aggregate
    method      of `optimize`
    tolerance   largest allowed `gap` of a result: difference of aggregates from their largest rows, a share of their size [-]
    max_rounds  largest number of optimizations; `rounds[-1].gap` is the gap of the last one
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
        raise InputError("problem", problem, "a Problem")
    if not _aggregates(problem):
        raise InputError(
            "problem", problem, "must have one in the objective or in a constraint", state="has no Aggregate"
        )
    require_range("tolerance", tolerance, 0.0, 1.0)
    require_count("max_rounds", max_rounds, 1, 100)
    start, factor, rounds = options.pop("start", None), 1.0, []
    while True:
        sharper = sharpened(problem, factor)
        result = optimize(sharper, method, start, **options)
        x, aggregates = result.x, _aggregates(sharper)
        motions = sharper.motions_by_system(x) if isinstance(sharper, Scenarios) else [sharper.motion(x)]
        motions = [motion.require_ok() for motion in motions]
        functions = aggregates, [a.largest for a in aggregates], [a.size for a in aggregates]
        values = [np.array([_largest(f, motions) for f in fs]) for fs in functions]
        rounds.append(Round(factor, result, *values))
        if rounds[-1].gap <= tolerance or len(rounds) == max_rounds:
            return rounds
        start, factor = result.x, factor * min(FASTEST, max(2.0, rounds[-1].gap / tolerance))


def _largest(function: Callable[[Trajectory], Tensor], motions: Sequence[Trajectory]) -> float:
    """The value of a function, of scenarios the largest."""
    return float(torch.cat([function(motion) for motion in motions]).max())


def sharpened(problem: Problem, factor: float) -> Problem:
    """The problem with the sharpness of all aggregates multiplied by `factor`."""

    def change(measure: Measure) -> Measure:
        if isinstance(measure, Aggregate):
            return replace(measure, sharpness=measure.sharpness * factor)
        return measure.mapped(change)

    result = copy.copy(problem)
    for name in ("reference", "steps", "coarse"):  # of the measures before
        result.__dict__.pop(name, None)
    vars(result).update(
        stated_objective=change(problem.stated_objective),
        objective=change(problem.objective),
        constraints=[replace(c, measure=change(c.measure)) for c in problem.constraints],
    )
    return result


def _aggregates(problem: Problem) -> list[Aggregate]:
    """All aggregates in the objective and the constraints, those of the objective first."""

    def within(measure: Measure) -> list[Aggregate]:
        itself = [measure] if isinstance(measure, Aggregate) else []
        return itself + [aggregate for operand in measure.operands for aggregate in within(operand)]

    measures = [problem.stated_objective, *(c.measure for c in problem.constraints)]
    return [aggregate for measure in measures for aggregate in within(measure)]
