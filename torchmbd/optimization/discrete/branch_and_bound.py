"""Discrete variables (ply angles in increments, areas from a list): branches pruned by gradients, candidates confirmed.

1. Relaxation: local searches from all starts with continuous variables; their distinct minima are the roots.
2. Branches: the variable farthest from its values gets two boxes, up to the value below and from the value above. Each box
   is searched again with gradients, from where its parent ended; a box whose minimum is not better than the best design on
   the values is dropped with all that lies in it. The boxes of a wave run in common batches: their simulations are one batch.
   Only a search that converged bounds its box. A box whose search ended otherwise keeps the bound of its parent and is
   divided; a box whose start fails is halved, and each half starts at its middle.
3. Confirmation: every minimum found is rounded and evaluated in full. Only evaluated designs are results. The extra variable
   of a min-max problem (extra_variable.py) is no choice: every design has the least that its own rows allow.
4. Certificate: all neighbors of the best design within two increments are evaluated; from a better one it goes on.

Exact where the problem is convex; otherwise the pruning trusts local minima, and the certificate says what is certain.
Source: Dakin, A tree-search algorithm for mixed integer programming problems, Computer J. 8 (1965) 250-255 (branching);
Gupta and Ravindran, Branch and bound experiments in convex nonlinear integer programming, Management Science 31 (1985)
1533-1546. Checked in tests/optimization/discrete/test_branch_and_bound.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from torchmbd.errors import argument_names, warnings_once
from torchmbd.optimization.api import FEASIBILITY, MAX_ITERATIONS, checked_box, require_limits, run_start
from torchmbd.optimization.cache import MemoryCachedProblem
from torchmbd.optimization.discrete.grid import Allowed, Grid
from torchmbd.optimization.multistart.batched import run_batched
from torchmbd.optimization.multistart.run import MultistartResult, multistart
from torchmbd.optimization.multistart.sampling import Starts
from torchmbd.optimization.optimizer import (
    DEFAULT_METHOD,
    Evaluation,
    NonlinearProgram,
    OptimizationResult,
    find_method,
    largest_violation,
    rank,
    require_count,
    require_method_of_size,
)
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
    """A box to search, from x.

    bound  nothing in the box is expected below: where the search of a box that contains it has converged; -inf without one
    value  where the search before ended, which decides the order; inf if its start failed
    """

    lower: np.ndarray
    upper: np.ndarray
    x: np.ndarray
    bound: float
    value: float


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
        has_extra = bool(getattr(cache, "has_extra_variable", False))
        self.tighten = cache.with_least_bound if has_extra else None
        self.extra = start[-1:] if has_extra else start[:0]  # designs are evaluated by that of the start
        self.feasibility, self.max_lanes = feasibility, max_lanes
        self.boxes, self.queue = 0, list[Branch]()  # searched, and left
        self.unfinished: list[Branch] = []  # searched without an optimum, and not to be divided
        self.best: Candidate | None = None
        self.rounded: Candidate | None = None  # plain rounding of the best relaxed minimum

    def run(self, relaxed: MultistartResult, max_boxes: int) -> bool:
        """Search the boxes below the relaxed minima; return whether the user stopped it."""
        roots = [(m.x, m.value, m.value) for m in relaxed.minima]
        if relaxed.best is not None and not roots:
            roots = [(relaxed.best.x, -np.inf, relaxed.best.value)]
        first = self.confirm(np.array([x for x, _, _ in roots] or [r.x for r in relaxed.results]))
        self.rounded = first[0] if first else None
        queue = [branch for root in roots for branch in self.root(*root)]
        if not roots and any(r.status == "failed" for r in relaxed.results):
            queue = self.halve(Branch(self.lower, self.upper, relaxed.results[0].x, -np.inf, np.inf))
        while queue and self.boxes < max_boxes:
            queue = sorted((b for b in queue if b.bound < self.limit), key=lambda b: b.value)
            room = min(self.max_lanes, max_boxes - self.boxes)
            wave, queue = queue[:room], queue[room:]
            ends: list[OptimizationResult] = []
            searches = [partial(self.search, b) for b in wave]
            _, interrupted = run_batched(self.cache, searches, self.run_one, self.max_lanes, ends.append)
            if interrupted:
                return True
            self.boxes += len(wave)
            ends.sort(key=lambda end: end.start)
            feasible = [end.x for end in ends if end.status not in ("failed", "infeasible")]
            self.confirm(np.array(feasible).reshape(-1, self.lower.size))
            for branch, end in zip(wave, ends, strict=True):
                queue += self.divide(branch, end)
        self.queue = queue
        return False

    def root(self, x: np.ndarray, bound: float, value: float) -> list[Branch]:
        """Return the branches of a relaxed minimum, or the box of all values if the minimum lies outside."""
        inside = np.clip(x, self.lower, self.upper)
        whole = Branch(self.lower, self.upper, inside, bound, value)
        return self.split(whole) if np.array_equal(inside, x) else [whole]

    def divide(self, branch: Branch, end: OptimizationResult) -> list[Branch]:
        """Return the parts of a box that may hold a better design than those found, after its search."""
        if end.status == "infeasible":
            return []
        if end.status == "failed":
            return self.halve(branch)
        bound = end.value if end.converged else branch.bound
        return self.split(replace(branch, x=end.x, bound=bound, value=end.value), end.converged)

    def split(self, branch: Branch, converged: bool = True) -> list[Branch]:
        """Return the two boxes beside the gap that the most undecided variable lies in.

        If all are on values, there are none after a search that converged; otherwise the box is cut beside x.
        """
        off = self.grid.off(branch.x)
        j = int(np.argmax(off))
        if off[j] > 0.0:
            return self.cut(branch, j, *self.grid.around(branch.x, j))
        return [] if converged else self.halve(branch, branch.x)

    def halve(self, branch: Branch, x: np.ndarray | None = None) -> list[Branch]:
        """Return two parts of a box, cut beside x in the variable with most values; without x in the middle, to start there."""
        values = [self.grid.within(j, branch.lower[j], branch.upper[j]) for j in range(branch.x.size)]
        j = int(np.argmax([len(v) for v in values]))
        if len(values[j]) < 2:
            if (branch.lower < branch.upper).any():  # continuous variables, of one choice of the others
                self.unfinished.append(branch)
            return []
        k = (len(values[j]) - 1) // 2 if x is None else int(np.argmin(np.abs(values[j] - x[j])))
        k = min(k, len(values[j]) - 2)
        parts = self.cut(branch, j, float(values[j][k]), float(values[j][k + 1]))
        return [replace(part, x=_middle(part), value=np.inf) for part in parts] if x is None else parts

    def cut(self, branch: Branch, j: int, below: float, above: float) -> list[Branch]:
        """Return the parts of a box up to a value of variable j, and from the next one, if they are not empty."""
        lower, upper, branches = branch.lower, branch.upper, []
        for side, edge in ((upper, below), (lower, above)):
            if lower[j] <= edge <= upper[j]:
                moved = side.copy()
                moved[j] = edge
                box = (lower, moved) if side is upper else (moved, upper)
                branches.append(Branch(*box, np.clip(branch.x, *box), branch.bound, branch.value))
        return branches

    def search(self, branch: Branch, index: int, evaluate_batch: EvaluateBatch, report: Report) -> Search:
        return Search.of(
            self.cache,
            evaluate_batch,
            branch.x,
            branch.lower,
            branch.upper,
            scale=self.scale,
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
            designs = np.array([self.evaluated_at(x) for x in rounded[first : first + self.max_lanes]])
            for x, evaluation in zip(designs, self.cache.evaluate(designs, False), strict=True):
                if evaluation.ok and np.isfinite(evaluation.objective):
                    candidates.append(self.candidate(x, evaluation))
        for candidate in candidates:
            if self.best is None or self.better(candidate, self.best):
                self.best = candidate
        return candidates

    def evaluated_at(self, x: np.ndarray) -> np.ndarray:
        """Return the design [n] with the extra variable of the start, so that no choice is evaluated twice."""
        return np.append(self.choices(x), self.extra)

    def choices(self, x: np.ndarray) -> np.ndarray:
        """Return the design [n] without the extra variable."""
        return x[: x.size - self.extra.size]

    def candidate(self, x: np.ndarray, evaluation: Evaluation) -> Candidate:
        if self.tighten is not None:
            x, evaluation = self.tighten(x, evaluation)
        c = np.atleast_1d(evaluation.constraints)
        equality = np.isin(np.arange(c.size), [] if self.equalities is None else self.equalities)
        return Candidate(x, evaluation.objective, largest_violation(c, equality))

    def rank(self, candidate: Candidate) -> tuple[bool, float]:
        return rank(candidate.value, candidate.violation, self.feasibility)

    def better(self, a: Candidate, b: Candidate) -> bool:
        """True if a is better than b by more than rounding."""
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

    @property
    def unsearched(self) -> int:
        """Boxes that may hold something better, and whose search did not converge or begin."""
        return sum(branch.bound < self.limit for branch in self.unfinished)

    def candidates(self) -> list[Candidate]:
        """Return all evaluated designs on the values, the best first."""
        candidates = {
            self.choices(x).tobytes(): self.candidate(x, evaluation)
            for x, evaluation in self.cache.memory.entries.values()
            if evaluation.ok and np.array_equal(self.grid.nearest(x), x) and self.grid.admits(x)
        }
        return sorted(candidates.values(), key=self.rank)


def _middle(branch: Branch) -> np.ndarray:
    """Return the middle [n] of a box; a variable without finite bounds stays at x."""
    middle = 0.5 * (branch.lower + branch.upper)
    return np.where(np.isfinite(middle), middle, branch.x)


@dataclass(frozen=True)
class Certificate:
    """What is certain of the best design."""

    holds: bool  # no neighbor is better
    neighbors: int  # designs evaluated around it
    failed: int  # how many of them could not be evaluated
    which: str  # these neighbors in words
    closest: Candidate | None  # the best neighbor


@dataclass(frozen=True)
class DiscreteResult:
    best: Candidate | None
    status: (
        str  # as of OptimizationResult; "converged": feasible, the search of every box ended, and the certificate holds
    )
    message: str
    certificate: Certificate | None
    rounded: Candidate | None  # what plain rounding of the best relaxed minimum gives
    relaxed: MultistartResult
    candidates: list[Candidate]  # all designs on the values that were evaluated, the best first
    boxes: int  # searched with gradients
    analyses: int
    batches: int
    size: int  # designs that there are, continuous variables not counted
    names: list[str] = field(default_factory=list)


@warnings_once()
def optimize_discrete(
    problem: NonlinearProgram,
    allowed: Allowed | Sequence[Allowed],
    method: str = DEFAULT_METHOD,
    starts: Starts | list[Any] | np.ndarray | None = None,
    *,
    max_iterations: int = MAX_ITERATIONS,
    max_lanes: int = 64,
    max_boxes: int = 1000,
    max_neighbors: int = MAX_NEIGHBORS,
    admits: Callable[[np.ndarray], bool] = lambda x: True,
    feasibility: float = FEASIBILITY,
    **options: Any,
) -> DiscreteResult:
    """Minimize over designs whose variables take allowed values only.

    problem        as in `optimize`
    allowed        one entry per variable, an increment in its unit, a list of values, or None (continuous); one increment
                   applies to all [rad for angles: mbd.deg(5)]; the extra variable of a min-max problem stays continuous
    max_boxes      largest number of boxes that are searched; if others may contain a better design, the status is "max_boxes"
    max_neighbors  largest number of neighbors within two increments per variable; if there are more, the certificate covers
                   only neighbors whose increments add up to two
    admits         rules that a design [n] on the values must keep, such as those of a laminate; rounding then takes the
                   nearest admitted design within two increments. Write a rule that ties variables, such as symmetry, as a
                   link of the problem instead, because few designs keep such a rule
    method         of the relaxation; "auto" is "slsqp" here, since boxes begin beside an optimum
    starts, max_iterations, max_lanes, feasibility, options   of the relaxation, as in `multistart`

    All neighbors of a design have its continuous variables. Raises InputError for the same reasons as `multistart`, and if
    the bounds of a variable do not contain an allowed value.

    >>> energy = mbd.Integral(mbd.StrainEnergy("arm"))
    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-45, 45]))
    >>> found = mbd.optimization.optimize_discrete(problem, mbd.deg(45), max_iterations=3)
    >>> np.degrees(found.best.x).round(6).tolist(), found.size  # of 3 x 3 designs
    ([0.0, 0.0], 9)
    """
    function = find_method(method, options, argument_names(optimize_discrete))
    require_limits(max_iterations, None)
    require_count("max_boxes", max_boxes, 0, 1_000_000)
    require_count("max_neighbors", max_neighbors, 0, 1_000_000)
    box = checked_box(problem)
    require_method_of_size(method, box[0].size)
    if method == DEFAULT_METHOD:
        method, function = "slsqp", find_method("slsqp", options)
    grid = Grid(problem, allowed, box[1], box[2], getattr(problem, "period", None), admits)
    cache = MemoryCachedProblem(problem)
    relaxed = multistart(
        cache,
        method,
        starts,
        max_iterations=max_iterations,
        max_lanes=max_lanes,
        feasibility=feasibility,
        progress=False,
        **options,
    )

    def run_one(search: Search) -> OptimizationResult:
        return run_start(search, function, method, max_iterations, options, problem)

    branching = Branching(cache, grid, box, run_one, feasibility, max_lanes)
    certificate, interrupted = None, relaxed.interrupted
    try:
        interrupted |= branching.run(relaxed, max_boxes)
        if not interrupted:
            certificate = _certify(branching, max_neighbors)
    except KeyboardInterrupt:
        interrupted = True
    candidates = branching.candidates()
    best = candidates[0] if candidates else None
    status, message = _ended(best, certificate, interrupted, feasibility, branching)
    return DiscreteResult(
        best,
        status,
        message,
        certificate,
        branching.rounded,
        relaxed,
        candidates,
        branching.boxes,
        cache.computed,
        cache.batches,
        grid.size,
        list(problem.names),
    )


def _certify(branching: Branching, max_neighbors: int) -> Certificate | None:
    """Evaluate the neighbors of the best design, and those of the best among them, until none is better."""
    while True:
        candidates = branching.candidates()
        if not candidates:
            return None
        best = candidates[0]
        X, which = branching.grid.neighbors(best.x, STEPS, max_neighbors)
        neighbors = branching.confirm(X)
        closest = min(neighbors, key=branching.rank, default=None)
        if closest is None or not branching.better(closest, best):
            return Certificate(len(neighbors) == len(X), len(X), len(X) - len(neighbors), which, closest)


def _ended(
    best: Candidate | None,
    certificate: Certificate | None,
    interrupted: bool,
    feasibility: float,
    branching: Branching,
) -> tuple[str, str]:
    """Return status and sentence."""
    if interrupted:
        return "interrupted", "stopped by the user"
    if best is None or certificate is None:
        return "failed", "no design on the allowed values could be evaluated"
    around = f"{certificate.neighbors} neighbors, {certificate.which}"
    if branching.open:
        outcome = (
            f"no better design among {around}" if best.violation <= feasibility else "no feasible design was found"
        )
        return "max_boxes", f"{branching.open} boxes were left after {branching.boxes}; {outcome}"
    if best.violation > feasibility:
        return "infeasible", f"no feasible design on the allowed values was found; x violates least among its {around}"
    missing = []
    if branching.unsearched:
        missing.append(f"the searches of {branching.unsearched} boxes did not converge, or their starts failed")
    if not certificate.holds:
        missing.append(f"{certificate.failed} of {around}, could not be evaluated")
    if missing:
        others = "none of the others is better" if not certificate.holds else f"no better design among {around}"
        return "stalled", "; ".join([*missing, others])
    return "converged", f"no better design among {around}"
