"""A family of problems over the same designs (the points of a Pareto front): solved in common batches, warming each other.

A member is a function that makes one objective and its constraints of a design's criteria. Members start between the designs
of their neighbors. All look at one memory of evaluated designs: a member starts again if the search of another came across
a better design than its own, so they help each other out of local minima.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from torchmbd.optimization.cache import Cache
from torchmbd.optimization.criteria import Criteria
from torchmbd.optimization.multistart.batched import run_batched
from torchmbd.optimization.optimizer import Evaluation, OptimizationResult
from torchmbd.optimization.search import Ask, Report, Search, variable_scale

Member = Callable[[Criteria], Evaluation]

BETTER = 1e-4  # so much lower must a design be to start again from it; members are of order one
AGAIN = 3  # times


class Family:
    """`run_one` runs an optimizer on one search; `box` is start, lower and upper [n]; `ended` hears of every search's end."""

    def __init__(
        self,
        cache: Cache[Criteria],
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

    def from_starts(self, members: list[Member], starts: np.ndarray) -> list[OptimizationResult | None]:
        """Return the best feasible result of each member from all `starts` [count, n]."""
        ends = self._run([(member, x) for member in members for x in starts])
        groups = [ends[i * len(starts) : (i + 1) * len(starts)] for i in range(len(members))]
        best = [min((r for r in group if r is not None), key=lambda r: r.value, default=None) for group in groups]
        return self._improved(members, best)

    def in_waves(
        self,
        members: list[Member],
        places: np.ndarray,
        solved: list[np.ndarray],
        waves: list[list[int]],
        starts: np.ndarray,
    ) -> list[OptimizationResult | None]:
        """Return the feasible result of each member, one wave of members after the other.

        `places` [solved + members, k] says who is near whom: a member starts between the designs of its k nearest
        neighbors that are solved; at first these are the designs `solved`. In the end all start from `starts` [count, n] too.
        """
        results: list[OptimizationResult | None] = [None] * len(members)
        designs: dict[int, np.ndarray] = dict(enumerate(solved))
        for wave in waves:
            ends = self._run([(members[i], _between(places, designs, len(solved) + i)) for i in wave])
            for i, end in zip(wave, ends, strict=True):
                results[i] = end
                if end is not None:
                    designs[len(solved) + i] = end.x
        self._keep(results, [(i, x) for i in range(len(members)) for x in starts], members)
        return self._improved(members, results)

    def _keep(
        self, results: list[OptimizationResult | None], jobs: list[tuple[int, np.ndarray]], members: list[Member]
    ) -> None:
        """Run members (by index) from designs; put the results that are better than those known in their place."""
        ends = self._run([(members[i], x) for i, x in jobs])
        for (i, _), end in zip(jobs, ends, strict=True):
            known = results[i]
            if end is not None and (known is None or end.value < known.value):
                results[i] = end

    def _improved(
        self, members: list[Member], results: list[OptimizationResult | None]
    ) -> list[OptimizationResult | None]:
        for _ in range(AGAIN):
            jobs = []
            for i, member in enumerate(members):
                rank, x = self._best(member)
                result = results[i]
                if not rank[0] and (result is None or rank[1] < result.value - BETTER):
                    jobs.append((i, x))
            self._keep(results, jobs, members)
        return results

    def _best(self, member: Member) -> tuple[tuple[bool, float], np.ndarray]:
        """Return rank and design of the best known for `member`: feasible before infeasible, then the lowest."""
        best = (True, np.inf), self.start
        for x, criteria in self.cache.memory.known.values():
            single = member(criteria)
            if single.ok:
                violation = float(np.maximum(single.constraints, 0.0).max(initial=0.0))
                infeasible = violation > self.feasibility
                best = min(best, ((infeasible, violation if infeasible else single.objective), x), key=lambda b: b[0])
        return best

    def _run(self, jobs: list[tuple[Member, np.ndarray]]) -> list[OptimizationResult | None]:
        """Run members from designs in common batches; None where no feasible design was found."""
        if self.interrupted or not jobs:
            return [None] * len(jobs)

        searches = [partial(self._search, member, x) for member, x in jobs]
        ends, self.interrupted = run_batched(self.cache, searches, self.run_one, self.max_lanes, self.ended)
        return [end if end is not None and end.violation <= self.feasibility else None for end in ends]

    def _search(self, member: Member, x: np.ndarray, index: int, ask: Ask, report: Report) -> Search:
        def ask_member(X: np.ndarray, gradients: bool) -> list[Evaluation]:
            return [member(criteria) for criteria in ask(X, gradients)]  # type: ignore[arg-type]

        scale = variable_scale(self.start, self.lower, self.upper)
        return Search(
            ask_member,
            x,
            self.lower,
            self.upper,
            scale=scale,
            feasibility=self.feasibility,
            index=index,
            report=report,
        )


def _between(places: np.ndarray, designs: dict[int, np.ndarray], i: int) -> np.ndarray:
    """Return the mean of the designs of the k nearest neighbors of place i, weighted by their nearness."""
    known = list(designs)
    distance = np.linalg.norm(places[known] - places[i], axis=1)
    nearest = np.argsort(distance, kind="stable")[: places.shape[1]]
    weights = 1.0 / distance[nearest]
    return weights @ np.array([designs[known[j]] for j in nearest]) / weights.sum()
