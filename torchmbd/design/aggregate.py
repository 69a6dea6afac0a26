"""Many rows with one limit as one smooth number, whose gradient costs one reverse pass.

    ks       c/rho ln sum exp(rho y_k / c)     above the largest row by at most c ln(rows) / rho
    p_norm   (sum max(y_k, 0)^p)^(1/p)         above the largest row by at most the factor rows^(1/p)

Both are not below the largest row: if the aggregate is below a limit, all rows are below it, with a margin that makes the
optimum somewhat worse. An aggregate of large sharpness has a small one, but is badly conditioned. So `sharpen` optimizes again
and again: the sharpness grows by the ratio of the gap between aggregates and largest rows to the tolerance, at most tenfold.

Source: Kreisselmeier and Steinhauser, IFAC Symp. Computer Aided Design of Control Systems (1979) 113-117; Poon and Martins,
Structural and Multidisciplinary Optimization 34 (2007) 61-73, whose constants adapt as well.
Checked in tests/design/test_aggregate.py.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.problem import Problem
from torchmbd.design.response import Measure
from torchmbd.design.scenarios import Scenarios
from torchmbd.errors import InputError, checked_signature, unknown
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import list_of, scalar
from torchmbd.optimization import OptimizationResult, optimize
from torchmbd.optimization.optimizer import require_count, require_range

KINDS = ("ks", "p_norm")


@checked_signature
@dataclass(frozen=True)
class Aggregate(Measure):
    """One smooth number [lanes] for all rows of measures, in their unit, not below the largest row.

    measures   a measure, as AtTimes with many rows, or several in one unit
    kind       "ks" (Kreisselmeier-Steinhauser), or "p_norm", for rows of which the largest is positive
    sharpness  rho or p, positive: the larger, the nearer to the largest row, and the less smooth [-]
    scale      c of "ks", positive: the size of the rows, in their unit; "p_norm" needs none

    `largest(motion)` is the largest row itself.
    Source: Kreisselmeier and Steinhauser (1979).

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> limits = [mbd.Max(mbd.Displacement("arm", axis, node="right")) for axis in ("y", "z")]
    >>> aggregate = mbd.Aggregate(limits, scale=1e-3)
    >>> bool(aggregate(motion) >= aggregate.largest(motion))
    True
    """

    measures: Measure | Sequence[Measure]
    kind: str = "ks"
    sharpness: float = 50.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        if isinstance(self.measures, Measure):
            object.__setattr__(self, "measures", [self.measures])
        if not list_of("measures", self.measures, Measure, "a measure, or a list of them"):
            raise InputError("measures is []; allowed: a measure, or at least one in a list")
        if not isinstance(self.kind, str) or self.kind not in KINDS:
            raise unknown("kind", self.kind, KINDS)
        for name, x in (("sharpness", self.sharpness), ("scale", self.scale)):
            if scalar(name, x, "a positive number") <= 0.0:
                raise InputError(f"{name} is {x!r}; allowed: a positive number")
        if self.kind == "p_norm" and self.scale != 1.0:
            raise InputError(f"scale is {self.scale!r} with kind 'p_norm', which needs none; allowed: 1.0")

    @property
    def operands(self) -> Sequence[Measure]:
        assert not isinstance(self.measures, Measure)  # a list since __post_init__
        return self.measures

    def mapped(self, change: Callable[[Measure], Measure]) -> Measure:
        return replace(self, measures=[change(measure) for measure in self.operands])

    def _rows(self, motion: Trajectory) -> Tensor:
        """All rows [lanes, rows]."""
        return torch.cat([m.value(motion).reshape(motion.lanes, -1) for m in self.operands], 1)

    def value(self, motion: Trajectory) -> Tensor:
        rows, rho = self._rows(motion), float(self.sharpness)
        if self.kind == "ks":
            return torch.logsumexp(rho / self.scale * rows, 1) * (self.scale / rho)
        # Logarithms avoid overflow of powers.
        return torch.exp(torch.logsumexp(rho * rows.clamp_min(torch.finfo(rows.dtype).tiny).log(), 1) / rho)

    def change(self, motion: Trajectory) -> Tensor:
        return torch.cat([m.size(motion).reshape(motion.lanes, -1) for m in self.operands], 1).amax(1)

    def largest(self, motion: Trajectory) -> Tensor:
        """The largest row [lanes]."""
        return motion.sound(self._rows(motion).amax(1))


FASTEST = 10.0  # the sharpness grows by no more between two optimizations


class Round(NamedTuple):
    """One optimization of `sharpen`.

    factor      by which the sharpness of the problem is multiplied
    result      of the optimization
    aggregates  values at the optimum, one for each aggregate, in their units
    largest     the exact largest rows of the aggregates there
    """

    factor: float
    result: OptimizationResult
    aggregates: np.ndarray
    largest: np.ndarray

    @property
    def gap(self) -> float:
        """The largest relative difference of an aggregate from its largest row."""
        return float(np.max((self.aggregates - self.largest) / np.maximum(np.abs(self.largest), np.finfo(float).tiny)))


@checked_signature
def sharpen(
    problem: Problem, method: str = "mma", tolerance: float = 0.01, max_rounds: int = 6, **options: Any
) -> list[Round]:
    """Optimize with growing sharpness of the aggregates; return all rounds, of which the last has the result.

    problem     whose objective or constraints contain an Aggregate
    method      of `optimize`
    tolerance   largest allowed `gap` of a result: relative difference of aggregates from their largest rows [-]
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
        raise InputError(f"problem is {problem!r}; allowed: a Problem")
    if not _aggregates(problem):
        raise InputError("problem has no Aggregate; allowed: one in the objective or in a constraint")
    require_range("tolerance", tolerance, 0.0, 1.0)
    require_count("max_rounds", max_rounds, 1, 100)
    start, factor, rounds = options.pop("start", None), 1.0, []
    while True:
        sharper = sharpened(problem, factor)
        result = optimize(sharper, method, start, **options)
        x, aggregates = result.x, _aggregates(sharper)
        motions = sharper.motions_by_system(x) if isinstance(sharper, Scenarios) else [sharper.motion(x)]
        motions = [motion.require_ok() for motion in motions]
        values = [np.array([_largest(f, motions) for f in fs]) for fs in (aggregates, [a.largest for a in aggregates])]
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
    result.__dict__.pop("reference", None)
    result.stated_objective, result.objective = change(problem.stated_objective), change(problem.objective)
    result.constraints = [replace(c, measure=change(c.measure)) for c in problem.constraints]
    return result


def _aggregates(problem: Problem) -> list[Aggregate]:
    """All aggregates in the objective and the constraints, those of the objective first."""

    def within(measure: Measure) -> list[Aggregate]:
        itself = [measure] if isinstance(measure, Aggregate) else []
        return itself + [aggregate for operand in measure.operands for aggregate in within(operand)]

    measures = [problem.stated_objective, *(c.measure for c in problem.constraints)]
    return [aggregate for measure in measures for aggregate in within(measure)]
