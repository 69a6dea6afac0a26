"""The Pareto front of several criteria by the normalized normal constraint method.

1. Anchors: each criterion f_i is minimized alone. Where several designs have its minimum, such as all fiber angles for a
   mass, a second search takes the one that is best for the other criteria:
       minimize sum_j (f_j - utopia_j) / range_j + (f_i - utopia_i) / (TIE range_i),   range = nadir - utopia
   g = (f - utopia) / (nadir - utopia) makes criteria comparable: utopia holds the anchors' best values, nadir their worst.
2. The plane through the anchors g^1 .. g^k is covered evenly by points p.
3. For each p:   minimize g_k(x)   subject to   (g^k - g^i)'(g(x) - p) <= 0,   i = 1 .. k-1,   and the constraints of x.
4. Dropped are dominated points (of local fronts, behind a gap), and points where the multipliers mu_i give a criterion a
   negative weight in   w = e_k + sum_i mu_i (g^k - g^i),   so that all criteria could be improved at once.

The points are solved in waves of doubling size, those farthest from the solved points first. The simulations of a wave are one
batch; its searches start between the designs of the points solved before (warm_start.py).

Source: Messac, Ismail-Yahaya and Mattson, The normalized normal constraint method for generating the Pareto frontier,
Structural and Multidisciplinary Optimization 25 (2003) 86-98. Checked in tests/optimization/test_pareto.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmbd.errors import InputError, argument_names, true_or_false, warnings_once
from torchmbd.optimization.api import FEASIBILITY, MAX_ITERATIONS, checked_box, require_limits, run_start
from torchmbd.optimization.cache import MemoryCachedProblem
from torchmbd.optimization.criteria import Criteria, ManyCriteria
from torchmbd.optimization.multistart.sampling import Starts, recipe
from torchmbd.optimization.multistart.warm_start import MIN_GAIN, ScalarizedSearches
from torchmbd.optimization.optimizer import (
    DEFAULT_METHOD,
    Evaluation,
    OptimizationResult,
    find_method,
    require_count,
    require_method_of_size,
    require_problem,
    require_range,
)
from torchmbd.optimization.search import Search
from torchmbd.optimization.units import first_order_change, unit_of, variable_scale

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

DIVISIONS = 10
# Weight of the other criteria in an anchor: among equal minima it selects the one that is best for them. A second search, in
# whose objective they are of order one, resolves them.
TIE = 1e-4
NEGATIVE_WEIGHT = 1e-2  # a criterion with a weight below minus this could be improved at no cost
SAME = 1e-6  # share of the range of each criterion: smaller differences count as none


@dataclass(frozen=True)
class ParetoPoint:
    x: np.ndarray
    criteria: np.ndarray  # [k]
    weights: np.ndarray  # [k], sum one: the exchange rates of the criteria, each in units of its range on the front
    result: OptimizationResult  # of the problem of one criterion that found it


@dataclass(frozen=True)
class Front:
    """Points that do not dominate each other, sorted by the first criterion."""

    points: list[ParetoPoint]
    anchors: list[ParetoPoint]  # the minimum of each criterion
    dropped: int  # points found that are no Pareto points
    failed: int  # points of the plane for which no feasible design was found
    analyses: int
    batches: int
    interrupted: bool = False
    names: list[str] = field(default_factory=list)  # of the criteria

    @property
    def criteria(self) -> np.ndarray:
        """Criteria of the points [points, k]."""
        return np.array([point.criteria for point in self.points])

    def to_dataframe(self) -> DataFrame:
        """A row for each point: its criteria by their names, and the design by those of the variables."""
        import pandas as pd

        rows = [
            dict(zip(self.names, p.criteria.tolist(), strict=True))
            | dict(zip(p.result.names, p.x.tolist(), strict=True))
            for p in self.points
        ]
        return pd.DataFrame(rows)

    def plot(self, headings: Sequence[str] = (), title: str = "") -> Figure:
        """Return a figure of the criteria over the first; `headings` replace their names at the axes."""
        from torchmbd.viz.figures import BEST, figure_of, titled

        first, *others = headings or self.names
        figure, axes = figure_of(2.2 + 1.4 * len(others), rows=len(others))
        for ax, name, values in zip(axes, others, self.criteria.T[1:], strict=True):
            ax.plot(self.criteria[:, 0], values, color=BEST, marker="o", ms=4, lw=1.0)
            ax.set_ylabel(name)
        axes[-1].set_xlabel(first)
        titled(figure, title)
        return figure

    @property
    def utopia(self) -> np.ndarray:
        """The anchors' best values [k]."""
        return np.min([anchor.criteria for anchor in self.anchors], axis=0)

    @property
    def nadir(self) -> np.ndarray:
        """The anchors' worst values [k]."""
        return np.max([anchor.criteria for anchor in self.anchors], axis=0)


@warnings_once()
def pareto_front(
    problem: ManyCriteria,
    divisions: int = DIVISIONS,
    method: str = DEFAULT_METHOD,
    starts: Starts | list[Any] | np.ndarray | None = None,
    ended: Callable[[OptimizationResult], None] | None = None,
    *,
    everywhere: bool = False,
    max_iterations: int = MAX_ITERATIONS,
    max_lanes: int = 64,
    feasibility: float = FEASIBILITY,
    **options: Any,
) -> Front:
    """Find the Pareto-optimal designs: no other design is better in all criteria.

    problem     a Tradeoff, or another problem of several criteria
    divisions   steps between two anchors; C(divisions + k - 1, k - 1) points in all, of k criteria
    starts      of the anchors' searches, as in `multistart`
    ended       called with every OptimizationResult when its search ends; its value is the objective of this search
    everywhere  use the starts for every point too, for problems with local fronts
    method, max_iterations, max_lanes, feasibility, options   of every search, as in `multistart`

    Raises InputError for the same reasons as `optimize`, for fewer than two criteria, and if the search for an anchor does
    not find a feasible design. After the anchors are known, Ctrl-C returns the points that are finished.

    >>> deflection, mass = mbd.RMS(mbd.Displacement("arm", "z", node="right")), mbd.Mass("arm")
    >>> tradeoff = mbd.Tradeoff(
    ...     mbd.examples.arm(),
    ...     0.05,
    ...     {"deflection": deflection, "mass": mass},
    ...     variables=["arm.laminate.thickness"],
    ...     bounds=(0.5e-3, 2e-3),
    ...     steps=10,
    ... )
    >>> front = mbd.optimization.pareto_front(tradeoff, divisions=2, max_iterations=3)
    >>> front.criteria.shape  # points, criteria
    (3, 2)
    """
    function = find_method(method, options, argument_names(pareto_front))
    require_limits(max_iterations, None)
    require_count("divisions", divisions, 1, 10_000)
    require_count("max_lanes", max_lanes, 1, 1_000_000)
    require_range("feasibility", feasibility, 0.0, 1.0)
    everywhere = true_or_false("everywhere", everywhere)
    require_problem(problem)
    require_method_of_size(method, len(problem.names))
    if len(getattr(problem, "criteria", ())) < 2:
        raise InputError("problem", problem, "must have at least two criteria for a front", hint="mbd.Tradeoff(...)")
    box = checked_box(problem)
    points = np.array([checked_box(problem, x)[0] for x in recipe(starts, box[0]).points(problem)])

    def run_one(search: Search) -> OptimizationResult:
        return run_start(search, function, method, max_iterations, options, problem)

    cache = MemoryCachedProblem(problem)
    searches = ScalarizedSearches(cache, run_one, box, feasibility, max_lanes, ended)
    units = _units(searches, points, list(problem.criteria))
    anchors = _anchors(searches, points, list(problem.criteria), units)
    inner_points, failed = _points_between(searches, anchors, divisions, points if everywhere else points[:0], units)
    points = [*anchors, *(point for point in inner_points if point.weights.min() >= -NEGATIVE_WEIGHT)]
    span = np.ptp([anchor.criteria for anchor in anchors], axis=0)
    keep = non_dominated(np.array([point.criteria for point in points]), SAME * span)
    return Front(
        [points[i] for i in keep],
        anchors,
        len(anchors) + len(inner_points) - len(keep),
        failed,
        cache.computed,
        cache.batches,
        searches.interrupted,
        list(problem.criteria),
    )


def group_sizes(criteria: int, starts: int, divisions: int = DIVISIONS, everywhere: bool = False) -> list[int]:
    """Return how many searches run together, group after group: anchors, waves of points, points from all starts.

    Both searches of anchors, and points, count once more: they are searched again where another search came across a better
    design.
    """
    waves = [len(wave) for wave in _waves(_simplex(divisions, criteria), criteria)]
    points = sum(waves)
    return [
        size
        for size in (criteria * starts, criteria, criteria**2, criteria, *waves, points * starts * everywhere, points)
        if size
    ]


def non_dominated(F: np.ndarray, same: np.ndarray | float = 0.0) -> list[int]:
    """Return the indices of the rows of F [points, k] that no other dominates, sorted by the first criterion.

    same  differences of the criteria that count as none [k]
    """
    keep: list[int] = []
    for i in np.lexsort(F.T[::-1]):
        if not np.any(np.all(F[keep] <= F[i] + same, axis=1)):
            keep = [j for j in keep if not np.all(F[i] <= F[j] + same)]
            keep.append(int(i))
    return keep


def _units(searches: ScalarizedSearches, starts: np.ndarray, names: list[str]) -> np.ndarray:
    """Return the units of the criteria [k] by their values and changes at a start, a constant part without influence."""
    known = [criteria for criteria in searches.cache.evaluate(starts, True) if criteria.ok]
    if not known:
        raise InputError("starts", allowed="must contain at least one design that can be evaluated")
    values, slopes = known[0].values, known[0].gradients
    if values.shape != (len(names),):
        raise InputError(
            ("problem", "evaluate"),
            allowed=f"must return criteria of shape {(len(names),)}, one for each of {', '.join(names)}",
            state=f"returned criteria of shape {values.shape}",
        )
    size = variable_scale(searches.start, searches.lower, searches.upper)
    changes = [0.0] * len(names) if slopes is None else [first_order_change(slope, size) for slope in slopes]
    return np.array([unit_of(value, change) for value, change in zip(values, changes, strict=True)])


def _anchors(
    searches: ScalarizedSearches, starts: np.ndarray, names: list[str], units: np.ndarray
) -> list[ParetoPoint]:
    """Return the minimum of each criterion."""
    weights = np.where(np.eye(len(names)), 1.0, TIE)
    results = searches.from_starts([partial(_weighted, row, np.zeros(len(names))) for row in weights / units], starts)
    if searches.interrupted:
        raise KeyboardInterrupt
    for name, result in zip(names, results, strict=True):
        if result is None:
            raise InputError(
                ("minimize", name),
                hint="more starts, or weaker constraints",
                noun=f"criterion {name!r}",
                state="has no feasible design from these starts",
            )
    anchors = [result for result in results if result is not None]
    F = np.array([searches.cache.evaluate(anchor.x[None], False)[0].values for anchor in anchors])
    span = np.where(np.ptp(F, axis=0) > SAME * units, np.ptp(F, axis=0), units)
    utopia, rows = F.min(axis=0), weights / TIE / span
    results = searches.from_starts([partial(_weighted, row, utopia) for row in rows], np.array([a.x for a in anchors]))
    for i, result in enumerate(results):
        if result is not None and result.value < rows[i] @ (F[i] - utopia) - MIN_GAIN:
            anchors[i] = result
    return [_point(searches, anchor, row) for anchor, row in zip(anchors, weights, strict=True)]


def _points_between(
    searches: ScalarizedSearches, anchors: list[ParetoPoint], divisions: int, starts: np.ndarray, units: np.ndarray
) -> tuple[list[ParetoPoint], int]:
    """Return the points between the anchors and the number of those for which there is no feasible design."""
    F = np.array([anchor.criteria for anchor in anchors])
    if (np.ptp(F, axis=0) <= SAME * units).any():
        return [], 0  # one design is best for several criteria: there is no plane
    G = (F - F.min(axis=0)) / np.ptp(F, axis=0)
    plane = _simplex(divisions, len(anchors)) @ G
    scalarizations = [partial(_normal_constraint, F, p) for p in plane[len(anchors) :]]
    results = searches.in_waves(
        scalarizations, plane, [anchor.x for anchor in anchors], _waves(plane, len(anchors)), starts
    )
    normals = G[-1] - G[:-1]
    points = []
    for result in results:
        if result is not None:
            weights = np.eye(len(F))[-1] + result.multipliers[: len(normals)] @ normals
            points.append(_point(searches, result, weights))
    return points, len(scalarizations) - len(points)


def _point(searches: ScalarizedSearches, result: OptimizationResult, weights: np.ndarray) -> ParetoPoint:
    criteria = searches.cache.evaluate(result.x[None], False)[0]
    return ParetoPoint(result.x, criteria.values, weights / np.abs(weights).sum(), result)


def _weighted(weights: np.ndarray, origin: np.ndarray, criteria: Criteria) -> Evaluation:
    """Return the evaluation of the sum of `weights` [k] times the criteria's differences from `origin` [k]."""
    if not criteria.ok:
        return Evaluation.failure(criteria.status)
    df = None if criteria.gradients is None else weights @ criteria.gradients
    return Evaluation(
        float(weights @ (criteria.values - origin)), criteria.constraints, df, criteria.constraint_gradients
    )


def _normal_constraint(F: np.ndarray, p: np.ndarray, criteria: Criteria) -> Evaluation:
    """Return the evaluation of the problem of a point p [k] of the plane through the anchors F [k, k].

    Its objective is of order one.
    """
    if not criteria.ok:
        return Evaluation.failure(criteria.status)
    utopia, span = F.min(axis=0), np.ptp(F, axis=0)
    G = (F - utopia) / span
    normals = G[-1] - G[:-1]
    g = (criteria.values - utopia) / span
    constraints = np.concatenate([normals @ (g - p), np.atleast_1d(criteria.constraints)])
    if criteria.gradients is None:
        return Evaluation(1.0 + float(g[-1]), constraints)
    dg, dc = criteria.gradients / span[:, None], criteria.constraint_gradients
    rows = normals @ dg if dc is None else np.vstack([normals @ dg, dc])
    return Evaluation(1.0 + float(g[-1]), constraints, dg[-1], rows)


def _simplex(divisions: int, count: int) -> np.ndarray:
    """Return evenly spread weights [points, count], each row of sum one, the corners first."""
    bars = combinations(range(divisions + count - 1), count - 1)
    weights = [np.diff([-1, *bar, divisions + count - 1]) - 1 for bar in bars]
    inner = [w / divisions for w in weights if w.max() < divisions]
    return np.vstack([np.eye(count), *inner])


def _waves(plane: np.ndarray, solved: int) -> list[list[int]]:
    """Return the indices of the points after the first `solved` in waves of doubling size.

    Each next point is the one farthest from all points before it.
    """
    distance = np.linalg.norm(plane[solved:, None] - plane[None, :solved], axis=2).min(axis=1)
    order: list[int] = []
    while len(order) < distance.size:
        i = int(np.argmax(distance))
        order.append(i)
        distance = np.minimum(distance, np.linalg.norm(plane[solved:] - plane[solved + i], axis=1))
        distance[order] = -1.0
    edges = [2**k - 1 for k in range(len(order).bit_length() + 1)]
    return [order[a:b] for a, b in pairwise(edges) if order[a:b]]
