"""Problems of one objective over the same designs, solved in common batches, starting from each other's designs.

A scalarization is a function that makes one objective with constraints of the criteria of a design: one criterion, or a point
of a Pareto front. Each starts between the designs of its solved neighbors. All search one memory of evaluated designs: where
the search of another came across a better design than its own, a scalarization is searched again from there. So they help
each other out of local minima.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from torchmbd.optimization.cache import MemoryCachedProblem
from torchmbd.optimization.criteria import Criteria
from torchmbd.optimization.multistart.batched import run_batched
from torchmbd.optimization.optimizer import Evaluation, OptimizationResult, largest_violation, rank
from torchmbd.optimization.search import EvaluateBatch, Report, Search
from torchmbd.optimization.units import variable_scale

Scalarization = Callable[[Criteria], Evaluation]

MIN_GAIN = 1e-4  # of the objective, which is of order one: the least for which a search is started again
RESTARTS = 3  # at most


class ScalarizedSearches:
    """Searches of scalarizations of one problem.

    run_one    runs an optimizer on one search
    box        start, lower and upper bounds [n]
    max_lanes  designs in one batch at most
    ended      called with every result when its search ends
    """

    def __init__(
        self,
        cache: MemoryCachedProblem[Criteria],
        run_one: Callable[[Search], OptimizationResult],
        box: tuple[np.ndarray, np.ndarray, np.ndarray],
        feasibility: float,
        max_lanes: int,
        ended: Callable[[OptimizationResult], None] | None = None,
    ) -> None:
        self.cache, self.run_one = cache, run_one
        self.start, self.lower, self.upper = box
        self.feasibility, self.max_lanes, self.ended = feasibility, max_lanes, ended
        self.interrupted = False

    def from_starts(
        self,
        scalarizations: list[Scalarization],
        starts: np.ndarray,
        known: list[OptimizationResult | None] | None = None,
    ) -> list[OptimizationResult | None]:
        """Return the best feasible result of each scalarization, of those that are known and from all `starts` [count, n]."""
        results: list[OptimizationResult | None] = known or [None for _ in scalarizations]
        jobs = [(i, x) for i in range(len(scalarizations)) for x in starts]
        self._run_and_keep_better(results, jobs, scalarizations)
        for _ in range(RESTARTS):  # from a better design than the result, where one is known
            jobs = []
            for i, (scalarization, result) in enumerate(zip(scalarizations, results, strict=True)):
                (infeasible, value), x = self._best_known(scalarization)
                if not infeasible and (result is None or value < result.value - MIN_GAIN):
                    jobs.append((i, x))
            self._run_and_keep_better(results, jobs, scalarizations)
        return results

    def in_waves(
        self,
        scalarizations: list[Scalarization],
        positions: np.ndarray,
        solved: list[np.ndarray],
        waves: list[list[int]],
        starts: np.ndarray,
    ) -> list[OptimizationResult | None]:
        """Return the feasible result of each scalarization, searched in waves.

        positions  points of the plane of criteria [solved + scalarizations, k]: a search starts between the designs of the k
                   nearest solved points
        solved     designs of the first points
        waves      indices of the scalarizations that are searched together
        starts     designs [count, n] from which all are searched once more
        """
        results: list[OptimizationResult | None] = [None] * len(scalarizations)
        designs: dict[int, np.ndarray] = dict(enumerate(solved))
        for wave in waves:
            jobs = [(scalarizations[i], _interpolated_design(positions, designs, len(solved) + i)) for i in wave]
            for i, end in zip(wave, self._run(jobs), strict=True):
                results[i] = end
                if end is not None:
                    designs[len(solved) + i] = end.x
        return self.from_starts(scalarizations, starts, results)

    def _run_and_keep_better(
        self,
        results: list[OptimizationResult | None],
        jobs: list[tuple[int, np.ndarray]],
        scalarizations: list[Scalarization],
    ) -> None:
        """Search scalarizations (by index) from designs; better results replace those in `results`."""
        ends = self._run([(scalarizations[i], x) for i, x in jobs])
        for (i, _), end in zip(jobs, ends, strict=True):
            known = results[i]
            if end is not None and (known is None or end.value < known.value):
                results[i] = end

    def _best_known(self, scalarization: Scalarization) -> tuple[tuple[bool, float], np.ndarray]:
        """Return sort key (optimizer.rank) and design of the best evaluated design of a scalarization."""
        best = (True, np.inf), self.start
        for x, criteria in self.cache.memory.entries.values():
            single = scalarization(criteria)
            if single.ok:
                key = rank(single.objective, largest_violation(single.constraints), self.feasibility)
                best = min(best, (key, x), key=lambda b: b[0])
        return best

    def _run(self, jobs: list[tuple[Scalarization, np.ndarray]]) -> list[OptimizationResult | None]:
        """Search scalarizations from designs in common batches; None where no feasible design was found."""
        if self.interrupted or not jobs:
            return [None] * len(jobs)
        searches = [partial(self._search, scalarization, x) for scalarization, x in jobs]
        ends, self.interrupted = run_batched(self.cache, searches, self.run_one, self.max_lanes, self.ended)
        return [end if end is not None and end.violation <= self.feasibility else None for end in ends]

    def _search(
        self, scalarization: Scalarization, x: np.ndarray, index: int, evaluate_batch: EvaluateBatch, report: Report
    ) -> Search:
        def evaluate_scalarized(X: np.ndarray, gradients: bool) -> list[Evaluation]:
            return [scalarization(criteria) for criteria in evaluate_batch(X, gradients)]  # type: ignore[arg-type]

        scale = variable_scale(self.start, self.lower, self.upper)
        return Search(
            evaluate_scalarized,
            x,
            self.lower,
            self.upper,
            scale=scale,
            feasibility=self.feasibility,
            index=index,
            report=report,
        )


def _interpolated_design(positions: np.ndarray, designs: dict[int, np.ndarray], i: int) -> np.ndarray:
    """Return the mean of the designs of the k solved points nearest to point i, weighted by 1 / distance."""
    known = list(designs)
    distance = np.linalg.norm(positions[known] - positions[i], axis=1)
    nearest = np.argsort(distance, kind="stable")[: positions.shape[1]]
    weights = 1.0 / distance[nearest]
    return weights @ np.array([designs[known[j]] for j in nearest]) / weights.sum()
