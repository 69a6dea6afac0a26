"""Optimizers of other packages as methods: what they see, when they are begun afresh, how they end.

Packages take a run over not-a-number for success (SciPy) or never return from it (NLopt), so they never see one. A failed
evaluation is returned as a wall: an objective far above the last one, from which line searches, trust regions and conservative
approximations turn back. If one stops on the wall all the same, it is begun afresh from the best design, inside a box that
leaves the wall outside. Absolute tolerances: where the objective fell far below the start's, it is begun afresh in units of
the objective reached, so that "small" means small there. And only a Kuhn-Tucker point, or nearly one where the package's
own criteria are met without a failure in sight, is called converged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.kkt import kuhn_tucker
from torchmbd.optimization.optimizer import Ending, Evaluation
from torchmbd.optimization.search import Search
from torchmbd.optimization.stationary import departure

RUNS = 4
SMALLEST_UNIT = 1e-9  # of the start's objective
FAR_BELOW = 0.05  # of the objective at the start of a run
WALL = 1e3  # times the last objective
LOOSE = 2e-2  # no claim of success is believed beyond this Kuhn-Tucker residual


class EvaluationFailed(Exception):
    """A package wants a gradient where the evaluation failed."""


class LimitReached(Exception):
    """A package would go beyond the limit of iterations."""


@dataclass(frozen=True)
class Stop:
    """How one run of a package ended: its design, whether it claims success, and its words."""

    y: np.ndarray
    success: bool
    message: str


class WrappedProblem:
    """The problem as a package sees it, the objective in `unit`, inside the box `lower`, `upper` around the begin `y`."""

    def __init__(
        self, search: Search, y: np.ndarray, unit: float, walls: list[np.ndarray], remaining: int, run: int = 0
    ) -> None:
        self.search, self.y, self.unit, self.walls, self.remaining = search, y, unit, walls, remaining
        self.shrink = 1e-2**run  # for what a package should start smaller in each further run
        radius = min((0.5 * float(np.abs(wall - y).max()) for wall in walls), default=np.inf)
        self.lower, self.upper = np.maximum(search.lower, y - radius), np.minimum(search.upper, y + radius)
        self.equal, self.unequal = np.flatnonzero(search.equality), np.flatnonzero(~search.equality)
        self._last = search.evaluate(y, gradients=True)
        self._recorded = {y.tobytes()}

    def value(self, y: np.ndarray) -> Evaluation:
        """Return values at `y`, or the wall."""
        evaluation = self.search.evaluate(y)
        if evaluation.ok:
            self._last = evaluation
            return evaluation
        last = self._last
        return Evaluation(last.objective + WALL * max(self.unit, abs(last.objective)), last.constraints)

    def gradient(self, y: np.ndarray) -> Evaluation:
        """Return values and gradients at `y`; there is none on the wall."""
        evaluation = self.search.evaluate(y, gradients=True)
        if not evaluation.ok:
            self.walls.append(np.array(y))
            raise EvaluationFailed(evaluation.status)
        return evaluation

    def record(self, y: np.ndarray) -> None:
        """Add `y` to the history if it is new there."""
        if y.tobytes() in self._recorded:
            return
        if self.remaining <= 0:
            raise LimitReached
        self.remaining -= 1
        self._recorded.add(y.tobytes())
        self.search.record(y)

    def objective(self, y: np.ndarray) -> float:
        return self.value(y).objective / self.unit

    def slope(self, y: np.ndarray) -> np.ndarray:
        df = self.gradient(y).objective_gradient
        assert df is not None
        return df / self.unit

    def constraints(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return self.value(y).constraints[rows]

    def jacobian(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        dc = self.gradient(y).constraint_gradients
        assert dc is not None
        return dc[rows]


def run_adapted(search: Search, run: Callable[[WrappedProblem], Stop], max_iterations: int, kkt: float) -> Ending:
    """Run a package, afresh where that helps, and say how it ended; `kkt`: residual at which an early stop is good enough."""
    first = search.begin()
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    y, here = departure(search, first)
    assert here.objective_gradient is not None
    if search.violation(here) <= search.feasibility and not here.objective_gradient.any():
        # Interior point methods would leave for the middle of the bounds.
        return Ending(y, "converged", "the gradient is zero")
    walls: list[np.ndarray] = []
    unit, message = 1.0, ""
    for number in range(RUNS):
        before, failures = y, search.failures
        remaining = max_iterations - (len(search.history) - 1)
        stop = _run_wrapped(WrappedProblem(search, y, unit, walls, remaining, number), run) if remaining > 0 else None
        if stop is None:
            break
        message = stop.message
        y, evaluation = _with_gradient(search, _better(search, stop.y), walls)
        quality = kuhn_tucker(evaluation, y, search.lower, search.upper, search.equality)
        feasible = search.violation(evaluation) <= search.feasibility
        reached = abs(evaluation.objective)
        if feasible and stop.success and 0.0 < reached < FAR_BELOW * unit and quality.residual > kkt:
            unit = max(reached, SMALLEST_UNIT)
            continue
        # What looks like a minimum beside a wall, or on the border of a box around one, is none.
        success = stop.success and not walls and search.failures == failures and quality.residual <= LOOSE
        if feasible and (success or quality.residual <= kkt):
            return Ending(y, "converged", message if success else f"{message}: a Kuhn-Tucker point")
        if (np.array_equal(before, y) or not feasible) and not walls:
            break
    return _ending(search, y if search.best is None else search.best, message, max_iterations)


def _run_wrapped(wrapped: WrappedProblem, run: Callable[[WrappedProblem], Stop]) -> Stop | None:
    """Run once; None if the limit of iterations ended it."""
    search = wrapped.search
    try:
        stop = run(wrapped)
        final = search.evaluate(stop.y, gradients=True)
        if final.ok:
            wrapped.record(stop.y)
            return stop
        wrapped.walls.append(stop.y)
        reason = final.status
    except LimitReached:
        return None
    except EvaluationFailed as wall:
        reason = str(wall)
    assert search.best is not None
    return Stop(search.best, False, f"stopped at a failed evaluation ({reason})")


def _better(search: Search, y: np.ndarray) -> np.ndarray:
    """Return `y`, or the best design seen where that is strictly better."""

    def rank(design: np.ndarray) -> tuple[bool, float]:
        evaluation = search.evaluate(design)
        violation = search.violation(evaluation)
        infeasible = violation > search.feasibility
        return infeasible, violation if infeasible else evaluation.objective

    best = search.best
    return y if best is None or rank(y) <= rank(best) else best


def _with_gradient(search: Search, y: np.ndarray, walls: list[np.ndarray]) -> tuple[np.ndarray, Evaluation]:
    """Return `y`, or the best design after it whose gradient does not fail, with its evaluation."""
    while not (evaluation := search.evaluate(y, gradients=True)).ok:
        walls.append(y)
        assert search.best is not None  # the start, if no other
        y = search.best
    return y, evaluation


def _ending(search: Search, y: np.ndarray, message: str, max_iterations: int) -> Ending:
    if len(search.history) - 1 >= max_iterations:
        return Ending(y, "max_iterations", f"{max_iterations} iterations were not enough to converge")
    evaluation = search.evaluate(y)
    violation = search.violation(evaluation)
    if violation > search.feasibility:
        violated = search.violated(evaluation)
        return Ending(y, "infeasible", f"{message}; constraints {violated} remain violated by up to {violation:.3g}")
    return Ending(y, "stalled", f"the way down leads into designs that fail; {message}" if search.failures else message)
