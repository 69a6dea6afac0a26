"""Branch and bound over the boxes between allowed values; branch_and_bound.py tells the method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from torchmbd.optimization.cache import MemoryCachedProblem
from torchmbd.optimization.discrete.grid import Grid
from torchmbd.optimization.multistart.batched import run_batched
from torchmbd.optimization.multistart.run import MultistartResult
from torchmbd.optimization.optimizer import Evaluation, OptimizationResult, largest_violation, rank
from torchmbd.optimization.search import EvaluateBatch, Report, Search
from torchmbd.optimization.units import variable_scale

WORTH = 1e-9  # relative improvement that counts
STEPS = 2  # increments: of the certificate, and of the way to an admitted design
MAX_NEIGHBORS = 1000


@dataclass(frozen=True)
class Candidate:
    """A design on the values, evaluated in full."""

    x: np.ndarray
    value: float
    violation: float


@dataclass(frozen=True)
class Branch:
    """A box to search, from x; nothing in it is expected below `bound`."""

    lower: np.ndarray
    upper: np.ndarray
    x: np.ndarray
    bound: float


class Branching:
    """`run_one` runs an optimizer on one search; `box` is start, lower and upper [n]."""

    def __init__(
        self,
        cache: MemoryCachedProblem[Evaluation],
        grid: Grid,
        box: tuple[np.ndarray, np.ndarray, np.ndarray],
        run_one: Callable[[Search], OptimizationResult],
        feasibility: float,
        max_lanes: int,
    ) -> None:
        start, lower, upper = box
        self.cache, self.grid, self.run_one = cache, grid, run_one
        self.scale = variable_scale(start, lower, upper)
        self.lower = np.array([low if v is None else v[0] for low, v in zip(lower, grid.values, strict=True)])
        self.upper = np.array([high if v is None else v[-1] for high, v in zip(upper, grid.values, strict=True)])
        self.equalities = getattr(cache, "equalities", None)
        self.feasibility, self.max_lanes = feasibility, max_lanes
        self.boxes, self.queue = 0, list[Branch]()  # searched, and left
        self.best: Candidate | None = None
        self.rounded: Candidate | None = None  # plain rounding of the best relaxed minimum

    def run(self, relaxed: MultistartResult, max_boxes: int) -> bool:
        """Search the boxes below the relaxed minima; return whether the user stopped it."""
        roots = [(m.x, m.value) for m in relaxed.minima]
        if relaxed.best is not None and not roots:
            roots = [(relaxed.best.x, relaxed.best.value)]
        first = self.confirm(np.array([x for x, _ in roots] or [r.x for r in relaxed.results]))
        self.rounded = first[0] if first else None
        queue = [branch for x, value in roots for branch in self.root(x, value)]
        while queue and self.boxes < max_boxes:
            queue = sorted((b for b in queue if b.bound < self.limit), key=lambda b: b.bound)
            room = min(self.max_lanes, max_boxes - self.boxes)
            wave, queue = queue[:room], queue[room:]
            ends, interrupted = run_batched(
                self.cache, [partial(self.search, b) for b in wave], self.run_one, self.max_lanes
            )
            if interrupted:
                return True
            self.boxes += len(wave)
            solutions = [(b, end) for b, end in zip(wave, ends, strict=True) if end is not None]
            self.confirm(np.array([end.x for _, end in solutions]).reshape(-1, self.lower.size))
            for branch, end in solutions:
                queue += self.split(branch.lower, branch.upper, end.x, end.value)
        self.queue = queue
        return False

    def root(self, x: np.ndarray, value: float) -> list[Branch]:
        """Return the branches of a relaxed minimum, or the box of all values if the minimum lies outside."""
        inside = np.clip(x, self.lower, self.upper)
        if np.array_equal(inside, x):
            return self.split(self.lower, self.upper, x, value)
        return [Branch(self.lower, self.upper, inside, value)]

    def split(self, lower: np.ndarray, upper: np.ndarray, x: np.ndarray, value: float) -> list[Branch]:
        """Return the two boxes beside the gap that the most undecided variable lies in; none if all are on values."""
        off = self.grid.off(x)
        j = int(np.argmax(off))
        if off[j] == 0.0:
            return []
        below, above = self.grid.around(x, j)
        branches = []
        for side, edge in ((upper, below), (lower, above)):
            if lower[j] <= edge <= upper[j]:
                moved = side.copy()
                moved[j] = edge
                box = (lower, moved) if side is upper else (moved, upper)
                branches.append(Branch(*box, np.clip(x, *box), value))
        return branches

    def search(self, branch: Branch, index: int, evaluate_batch: EvaluateBatch, report: Report) -> Search:
        return Search(
            evaluate_batch,
            branch.x,
            branch.lower,
            branch.upper,
            scale=self.scale,
            equalities=self.equalities,
            feasibility=self.feasibility,
            index=index,
            report=report,
        )

    def confirm(self, X: np.ndarray) -> list[Candidate]:
        """Round designs [k, n] and evaluate them; return those that could be evaluated, in their order."""
        candidates: list[Candidate] = []
        nearest = [self.grid.nearest_admitted(x, STEPS, MAX_NEIGHBORS) for x in X]
        rounded = [x for x in nearest if x is not None]
        for first in range(0, len(rounded), self.max_lanes):
            designs = np.array(rounded[first : first + self.max_lanes])
            for x, evaluation in zip(designs, self.cache.evaluate(designs, False), strict=True):
                if evaluation.ok and np.isfinite(evaluation.objective):
                    candidates.append(self.candidate(x, evaluation))
        for candidate in candidates:
            if self.best is None or self.better(candidate, self.best):
                self.best = candidate
        return candidates

    def candidate(self, x: np.ndarray, evaluation: Evaluation) -> Candidate:
        c = np.atleast_1d(evaluation.constraints)
        equality = np.isin(np.arange(c.size), [] if self.equalities is None else self.equalities)
        return Candidate(x, evaluation.objective, largest_violation(c, equality))

    def rank(self, candidate: Candidate) -> tuple[bool, float]:
        return rank(candidate.value, candidate.violation, self.feasibility)

    def better(self, a: Candidate, b: Candidate) -> bool:
        """Whether a is better than b by more than rounding."""
        (a_infeasible, a_value), (b_infeasible, b_value) = self.rank(a), self.rank(b)
        return a_infeasible < b_infeasible or (
            a_infeasible == b_infeasible and a_value < b_value - WORTH * abs(b_value)
        )

    @property
    def limit(self) -> float:
        """The value below which a box may hold something better."""
        if self.best is None or self.best.violation > self.feasibility:
            return np.inf
        return self.best.value - WORTH * abs(self.best.value)

    @property
    def open(self) -> int:
        """Boxes left that may hold something better."""
        return sum(branch.bound < self.limit for branch in self.queue)

    def candidates(self) -> list[Candidate]:
        """Return all evaluated designs on the values, the best first."""
        candidates = [
            self.candidate(x, evaluation)
            for x, evaluation in self.cache.memory.entries.values()
            if evaluation.ok and np.array_equal(self.grid.nearest(x), x) and self.grid.admits(x)
        ]
        return sorted(candidates, key=self.rank)
