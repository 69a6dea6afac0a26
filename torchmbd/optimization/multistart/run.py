"""Local searches from many starts in common batches: the minima, their basins, and how many may have been missed.

    expected number of minima  = w (N - 1) / (N - w - 2)           N local searches ended in w distinct minima
    share of the space covered = (N - w - 1) (N + w) / (N (N - 1))

both under a uniform prior on the basins' sizes, for starts drawn uniformly over the bounds.
Source: Boender and Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods, Math. Programming
37 (1987) 59-80.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmbd.errors import argument_names, true_or_false, warnings_once
from torchmbd.optimization.api import (
    FEASIBILITY,
    MAX_ITERATIONS,
    analyses_left,
    checked_box,
    require_limits,
    run_start,
)
from torchmbd.optimization.batch import parallel_batches
from torchmbd.optimization.failures import are_many, counted, failures_text
from torchmbd.optimization.finer_motions import (
    Begin,
    counted_from,
    refines,
    search_with_finer_motions,
    with_many_failures,
)
from torchmbd.optimization.multistart.batched import BatchedSearches
from torchmbd.optimization.multistart.sampling import Starts, recipe
from torchmbd.optimization.optimizer import (
    DEFAULT_METHOD,
    Iterate,
    NonlinearProgram,
    OptimizationResult,
    convergence_figure,
    find_method,
    gain_text,
    require_count,
    require_method_of_size,
    require_range,
)
from torchmbd.optimization.search import EvaluateBatch, Report, Search, deadline_of, is_over
from torchmbd.optimization.units import variable_scale
from torchmbd.process import one_thread_of_blas
from torchmbd.progress import shown
from torchmbd.summary import Summary, few, plural

_ROUNDING = 1e-9  # of a value: differences that are none


@dataclass(frozen=True)
class Minimum:
    x: np.ndarray
    value: float
    count: int  # searches that ended here: its basin
    starts: list[int]


def distinct_minima(
    results: Sequence[OptimizationResult],
    span: np.ndarray,
    x_tolerance: float = 0.01,
    value_tolerance: float = 1e-3,
    period: np.ndarray | None = None,
) -> list[Minimum]:
    """Return the distinct minima of the converged searches, best first.

    Two ends are one minimum if their values agree to `value_tolerance` of what the searches gained, so that a constant in the
    objective does not matter, and each variable to `x_tolerance` of `span` [n]; variables with a `period` [n] (0 where none;
    ply angles: half a turn) are compared on the circle.
    """
    ends = sorted((r for r in results if r.converged), key=lambda r: r.value)
    groups: list[list[OptimizationResult]] = []
    for end in ends:
        for group in groups:
            if _same(group[0], end, span, x_tolerance, value_tolerance, period):
                group.append(end)
                break
        else:
            groups.append([end])
    return [Minimum(group[0].x, group[0].value, len(group), sorted(r.start for r in group)) for group in groups]


def expected_minima(searches: int, minima: int) -> float:
    """Return the Bayesian estimate of how many minima there are; inf while there are too few searches to tell."""
    return minima * (searches - 1) / (searches - minima - 2) if searches > minima + 2 else float("inf")


def covered_share(searches: int, minima: int) -> float:
    """Return the Bayesian estimate of the share of the space whose minima are known; nan with too few searches."""
    if searches < minima + 2:
        return float("nan")
    return (searches - minima - 1) * (searches + minima) / (searches * (searches - 1))


def _same(
    a: OptimizationResult,
    b: OptimizationResult,
    span: np.ndarray,
    x_tolerance: float,
    value_tolerance: float,
    period: np.ndarray | None,
) -> bool:
    distance = np.abs(a.x - b.x)
    if period is not None:
        turn = np.where(period > 0.0, period, np.inf)
        distance = np.minimum(distance % turn, turn - distance % turn)
    near = bool((distance <= x_tolerance * span).all())
    gains = [abs(end.history[0].objective - end.value) for end in (a, b)]
    return near and abs(a.value - b.value) <= max(value_tolerance * max(gains), _ROUNDING * abs(a.value))


if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


@dataclass(frozen=True, repr=False)
class MultistartResult(Summary):
    """The results of a multistart, in the order of the starts."""

    results: list[OptimizationResult]
    minima: list[Minimum]  # distinct, best first
    interrupted: bool = False
    stopped_early: bool = False  # by `minima_left`, or by `max_time` before all starts began
    starts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # [count, n], also those that were not begun
    feasibility: float = FEASIBILITY  # violation of a constraint that counts as none

    def _summary(self) -> list[tuple[str, Any]]:
        best = self.best
        text = self._no_best_text
        if best is not None:
            text = f"{best.sign * best.value:.8g}, start {best.start} ({best.status}), {gain_text(best, self._first)}"
        values = few([f"{minimum.value:.6g}" for minimum in self.minima])
        return [
            ("starts", f"{len(self.results)} of {len(self.starts)}, {self.converged} converged"),
            ("best", text),
            ("active", "-" if best is None else few(best.active) if best.active else "no constraint and no bound"),
            ("minima", f"{len(self.minima)}: {values}" if self.minima else "none"),
            ("failures", failures_text(self.analyses, self.reasons)),
        ]

    @property
    def _first(self) -> Iterate | None:
        """The start of the first search, with which the best design is compared."""
        return next((r.history[0] for r in self.results if r.start == 0 and r.history), None)

    @property
    def _no_best_text(self) -> str:
        """Why there is no best design."""
        known = any(math.isfinite(result.violation) for result in self.results)
        return "no start ended with a feasible design" if known else "no design was evaluated"

    @property
    def reasons(self) -> dict[str, int]:
        """Reasons of failed evaluations of all starts, with how often each occurred, the commonest first."""
        return counted(pair for r in self.results for pair in r.reasons.items())

    @property
    def search_text(self) -> str:
        """How many searches converged, whether the best design is better than the first start, how many evaluations failed."""
        best, many = self.best, len(self.results)
        ending = f"{self.converged} of {plural(many, 'start')} converged"
        if best is not None and not best.converged:
            ending += f", the best did not ({best.status}: {best.message})"
        gain = self._no_best_text if best is None else gain_text(best, self._first)
        return f"{ending}; {gain}; {failures_text(self.analyses, self.reasons)}"

    @property
    def failing_text(self) -> str:
        """How many evaluations failed and why, where more than a tenth did; else ""."""
        return failures_text(self.analyses, self.reasons) if are_many(self.analyses, self.reasons) else ""

    def to_dataframe(self) -> DataFrame:
        """A row for each start: status, value, violation, Kuhn-Tucker residual, iterations, analyses, design by its names."""
        import pandas as pd

        rows = [
            {"start": r.start, "status": r.status, "value": r.value, "violation": r.violation}
            | {"kkt_residual": r.kkt_residual, "iterations": r.iterations, "analyses": r.analyses}
            | dict(zip(r.names or [f"x[{k}]" for k in range(len(r.x))], r.x, strict=True))
            for r in self.results
        ]
        return pd.DataFrame(rows).set_index("start") if rows else pd.DataFrame()

    def plot(self, title: str = "objective") -> Figure:
        """Figure of the objective and the largest violation of every start over its iterations; the best stands out."""
        return convergence_figure(self.results, self.best, title)

    @property
    def best(self) -> OptimizationResult | None:
        """The feasible result of lowest value, converged or not; None if no start ended feasible."""
        ended = [r for r in self.results if r.status not in ("infeasible", "failed")]
        return min((r for r in ended if r.violation <= self.feasibility), key=lambda r: r.value, default=None)

    @property
    def converged(self) -> int:
        """How many starts converged."""
        return sum(r.converged for r in self.results)

    @property
    def minima_left(self) -> float:
        """Bayesian estimate of the number of minima not found yet; inf while there are too few searches to tell."""
        return expected_minima(self.converged, len(self.minima)) - len(self.minima)

    @property
    def covered(self) -> float:
        """Bayesian estimate of the share of the space from which a search would end in a minimum known by now."""
        return covered_share(self.converged, len(self.minima))

    @property
    def analyses(self) -> int:
        return sum(r.analyses for r in self.results)

    @property
    def gradient_evaluations(self) -> int:
        return sum(r.gradient_evaluations for r in self.results)


@warnings_once()
@one_thread_of_blas()
def multistart(
    problem: NonlinearProgram,
    method: str = DEFAULT_METHOD,
    starts: Starts | list[Any] | np.ndarray | None = None,
    callback: Callable[[Iterate], None] | None = None,
    ended: Callable[[OptimizationResult], None] | None = None,
    *,
    max_iterations: int = MAX_ITERATIONS,
    max_lanes: int = 64,
    scaling: bool = True,
    feasibility: float = FEASIBILITY,
    eager_gradients: bool = True,
    max_analyses: int | None = None,
    max_time: float | None = None,
    minima_left: float | None = None,
    progress: bool | None = None,
    **options: Any,
) -> MultistartResult:
    """Minimize from every start; simulations of different starts share batches.

    problem      as in `optimize`; `problem.period` [n], if it has one, is the period of variables such as ply angles
    starts       `sobol(...)`, `latin_hypercube(...)` or a list of designs [count, n]; None: the problem's own start
    ended        called with every OptimizationResult when its start ends
    max_lanes    largest number of designs that are evaluated at the same time
    scaling      divide variables by the problem's start, the same for all starts
    minima_left  begin no further start once the estimated number of unknown minima is below it
    progress     a bar of the starts on standard error; None: in a terminal or a notebook
    max_time     limit of time for all starts [s]: after it no simulation and no start begins, and the starts that run end
                 with the status "max_time" and their best designs; None: no limit
    method, callback, max_iterations, feasibility, eager_gradients, max_analyses, options   as in `optimize`

    The result of a start that fails holds the reason. Ctrl-C ends every start; the results so far are returned with
    `interrupted` set.

    >>> energy = mbd.Integral(mbd.StrainEnergy("arm"))
    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-90, 90]))
    >>> study = mbd.optimization.multistart(problem, starts=mbd.optimization.sobol(2, seed=1), max_iterations=2)
    >>> study.to_dataframe().columns[:3].tolist()
    ['status', 'value', 'violation']
    >>> study.best.value == min(result.value for result in study.results)
    True
    """
    function = find_method(method, options, argument_names(multistart))
    require_limits(max_iterations, max_analyses)
    require_count("max_lanes", max_lanes, 1, 1_000_000)
    require_range("feasibility", feasibility, 0.0, 1.0)
    scaling = true_or_false("scaling", scaling)
    eager_gradients = true_or_false("eager_gradients", eager_gradients)
    initial, lower, upper = checked_box(problem)
    require_method_of_size(method, initial.size)
    points = np.array([checked_box(problem, point)[0] for point in recipe(starts, initial).points(problem)])
    settings = {
        "scale": variable_scale(initial, lower, upper) if scaling else None,
        "feasibility": feasibility,
        "eager_gradients": eager_gradients,
        "deadline": (deadline := deadline_of(max_time)),
    }

    def run_one(
        problem: NonlinearProgram, index: int, begin: Begin, evaluate_batch: EvaluateBatch, report: Report
    ) -> OptimizationResult:
        x, iterations, parts = begin
        limits = {"max_analyses": analyses_left(max_analyses, parts), "report": counted_from(parts, report)}
        search = Search.of(problem, evaluate_batch, x, lower, upper, **settings, **limits, index=index)
        return run_start(search, function, method, iterations, options, problem)

    span = np.where(np.isfinite(upper - lower), upper - lower, variable_scale(initial, lower, upper))
    period = getattr(problem, "period", None)
    find = partial(distinct_minima, span=span, period=None if period is None else np.asarray(period, dtype=float))

    def may_begin(results: list[OptimizationResult]) -> bool:
        if is_over(deadline):
            return False
        if minima_left is None:
            return True
        minima = find(results)
        return expected_minima(sum(r.converged for r in results), len(minima)) - len(minima) > minima_left

    interrupted = stopped_early = False
    several = refines(problem)  # parts: what ends a part is no result yet

    def search(problem: NonlinearProgram, begins: Mapping[int, Begin]) -> dict[int, OptimizationResult]:
        nonlocal interrupted, stopped_early
        done: list[OptimizationResult] = []
        is_first = not any(parts for _, _, parts in begins.values())

        def count(result: OptimizationResult) -> None:
            done.append(result)
            show(len(done), min((r.value for r in done if r.violation <= feasibility), default=np.nan))
            if ended is not None and not several:
                ended(with_many_failures(result))

        runners = {k: partial(run_one, problem, k, begin) for k, begin in begins.items()}
        groups = parallel_batches(problem) if minima_left is None else 1  # with several, `may_begin` depends on timing
        begin_further = may_begin if is_first else lambda results: True
        batched = BatchedSearches(problem, list(runners.values()), max_lanes, callback, begin_further, count, groups)
        results = batched.run()
        interrupted, stopped_early = interrupted or batched.interrupted, stopped_early or batched.stopped_early
        return {result.start: result for result in results}

    with shown(progress, f"{method}, starts", len(points)) as show:
        ends = search_with_finer_motions(search, problem, dict(enumerate(points)), max_iterations)
    results = [ends[k] for k in sorted(ends)]
    if ended is not None and several:
        for result in results:
            ended(result)
    return MultistartResult(results, find(results), interrupted, stopped_early, points, feasibility)
