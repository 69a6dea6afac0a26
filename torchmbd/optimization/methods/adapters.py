"""Optimizers of other packages as methods: failed evaluations, restarts, and how a run ends.

Failed evaluations: SciPy takes not-a-number for success, and NLopt never returns from it, so packages never see one. They get
an objective far above the last one, from which line searches, trust regions and conservative approximations turn back. A
package that ends at a failed design all the same is run again from the best design, in a box without the failed one.
Absolute tolerances: where the objective fell far below that of the start, the package is run again with the objective
divided by the value reached.
Status: "converged" is a Kuhn-Tucker point. Packages stop where the objective no longer falls by their tolerance. Where it
curves a lot, the Kuhn-Tucker conditions hold much nearer to the optimum than that, and a package that is run again has
forgotten the curvature. So a few quadratic steps follow, with the curvature of the gradients that the search has seen
(`last_steps`). Where they do not end in a Kuhn-Tucker point the package is run again, with smaller tolerances. From a
Kuhn-Tucker point that is not a minimum the package is run again as well, from a design beyond it (curvature.py).
Checked in tests/optimization/methods/test_adapters.py, and over the registry in tests/contracts/test_optimizers.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.curvature import beyond_saddle, lagrangian_gradient, perturb_stationary_start
from torchmbd.optimization.kkt import SMALLEST_OBJECTIVE
from torchmbd.optimization.methods.direction import VariableMetric, find_direction
from torchmbd.optimization.optimizer import Ending, Evaluation
from torchmbd.optimization.search import OutOfAnalyses, OutOfTime, Search

RUNS = 4
SMALLEST_UNIT = 1e-9  # of the start's objective
REST = 1e-8  # of the objective: a further run that lowers it by less is the last
FAR_BELOW = 0.05  # of the objective at the start of a run
FAILED_OBJECTIVE = 1e3  # of a failed evaluation, times the last objective
LAST_STEPS = 4
NEAR = 1e2  # times the option kkt: a residual from which the quadratic steps begin
MOST_CURVED = 200  # variables of matrices of n x n numbers that are factorized in every step


class EvaluationFailed(Exception):
    """A package asks for a gradient where the evaluation failed."""


class LimitReached(Exception):
    """A package would go beyond the limit of iterations."""


@dataclass(frozen=True)
class Stop:
    """How one run of a package ended: its design, whether it reports success, and its message."""

    y: np.ndarray
    success: bool
    message: str
    final: bool = False  # a further run would not help


class WrappedProblem:
    """The problem as a package sees it in one run.

    y          start of the run [n], scaled;  lower, upper   a box around it, without the designs `failed`
    unit       the objective is divided by it
    failed     designs [n] at which a package ended although they fail; further ones are appended
    remaining  iterations that are left
    """

    def __init__(
        self, search: Search, y: np.ndarray, unit: float, failed: list[np.ndarray], remaining: int, run: int
    ) -> None:
        self.search, self.y, self.unit, self.failed, self.remaining = search, y, unit, failed, remaining
        # Factor of sizes that a package starts with and of its tolerances: smaller ones in each further run.
        self.shrink = 1e-2**run
        radius = min((0.5 * float(np.abs(design - y).max()) for design in failed), default=np.inf)
        self.lower, self.upper = np.maximum(search.lower, y - radius), np.minimum(search.upper, y + radius)
        self.equal, self.unequal = np.flatnonzero(search.equality), np.flatnonzero(~search.equality)
        self._last = search.evaluate(y, gradients=True)
        self._recorded = {y.tobytes()}

    def value(self, y: np.ndarray) -> Evaluation:
        """Return values at `y`; of a failed design the last constraints, and an objective far above the last."""
        evaluation = self.search.evaluate(y)
        if evaluation.ok:
            self._last = evaluation
            return evaluation
        last = self._last
        high = last.objective + FAILED_OBJECTIVE * max(self.unit, abs(last.objective))
        return Evaluation(high, last.constraints)

    def gradient(self, y: np.ndarray) -> Evaluation:
        """Return values and gradients at `y`; EvaluationFailed if they cannot be evaluated."""
        evaluation = self.search.evaluate(y, gradients=True)
        if not evaluation.ok:
            self.failed.append(np.array(y))
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
    """Run a package, several times where that helps, and return how it ended.

    run  one run of the package;  kkt  Kuhn-Tucker residual of an optimum
    """
    first = search.begin()
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    most = len(search.history) + max_iterations  # entries of the history, which may have those of another method
    y, evaluation = perturb_stationary_start(search, first)
    assert evaluation.objective_gradient is not None
    left: float | None = None  # objective of the last saddle point that the search has left
    if search.violation(evaluation) <= search.feasibility and not evaluation.objective_gradient.any():
        # Interior point methods would leave for the middle of the bounds.
        beyond, unknown = _beyond(search, y, kkt)
        if beyond is None:
            return Ending(y, "converged", _joined("the gradient is zero", unknown))
        left, (y, evaluation) = evaluation.objective, beyond
    if not (search.upper > search.lower).any():
        feasible = search.violation(evaluation) <= search.feasibility
        return Ending(y, "converged" if feasible else "infeasible", "the bounds fix all variables")
    failed: list[np.ndarray] = []
    unit, message, number = 1.0, "", 0
    while number < RUNS:
        start = y
        remaining = most - len(search.history)
        if remaining <= 0:
            break
        stop = _run_wrapped(WrappedProblem(search, y, unit, failed, remaining, number), run)
        if stop is None:
            break
        message, before = stop.message, evaluation
        y, evaluation = _with_gradient(search, _better(search, stop.y), failed)
        quality = search.kuhn_tucker(evaluation, y)
        feasible = search.violation(evaluation) <= search.feasibility
        reached = abs(evaluation.objective)
        number += 1
        if feasible and stop.success and 0.0 < reached < FAR_BELOW * unit and quality.residual > kkt:
            unit = max(reached, SMALLEST_UNIT)
            continue
        end, note = None, "a Kuhn-Tucker point" if not stop.success else ""
        if feasible and quality.residual <= kkt:
            end = y
        elif feasible and stop.success and quality.residual <= NEAR * kkt:
            end, note = last_steps(search, y, evaluation, kkt), "quadratic steps from there end in a Kuhn-Tucker point"
        if end is not None:
            reached = search.evaluate(end).objective
            if left is not None and reached >= left - REST * max(abs(left), SMALLEST_OBJECTIVE):
                note = _joined(note, "beyond this saddle point nothing better was found")
                return Ending(end, "converged", _joined(message, note))
            beyond, unknown = _beyond(search, end, kkt)
            if beyond is None:
                return Ending(end, "converged", _joined(message, _joined(note, unknown)))
            left, number, (y, evaluation) = reached, 0, beyond
            continue
        if stop.final or ((np.array_equal(start, y) or not feasible) and not failed and not stop.success):
            break
        least = REST * max(abs(evaluation.objective), SMALLEST_OBJECTIVE)
        if number > 1 and feasible and not failed and before.objective - evaluation.objective <= least:
            break
    if len(search.history) >= most:
        message = f"{max_iterations} iterations were not enough to converge"
        return Ending(y if search.best is None else search.best, "max_iterations", message)
    return _ending(search, y if search.best is None else search.best, message)


def _beyond(search: Search, y: np.ndarray, kkt: float) -> tuple[tuple[np.ndarray, Evaluation] | None, str]:
    """As `beyond_saddle`; a limit of time or analyses that is reached there does not undo that the search has converged."""
    try:
        return beyond_saddle(search, y, kkt)
    except (OutOfTime, OutOfAnalyses):
        return None, "a limit was reached before the curvature was measured"


def _joined(message: str, note: str) -> str:
    return f"{message}: {note}" if message and note else message or note


def last_steps(search: Search, y: np.ndarray, evaluation: Evaluation, kkt: float) -> np.ndarray | None:
    """Return a feasible design [n] of a residual up to `kkt` that quadratic steps from y find; None: they find none.

    None also with equalities, which the subproblem of find_direction does not have.
    """
    if search.equality.any() or search.size > MOST_CURVED:
        return None
    multipliers = search.kuhn_tucker(evaluation, y).multipliers
    metric = VariableMetric(search.size)
    for other, known in search.nearest(y, 2 * search.size)[::-1]:  # the nearest last: it counts most
        metric.update(y - other, lagrangian_gradient(evaluation, multipliers) - lagrangian_gradient(known, multipliers))
    for _ in range(LAST_STEPS):
        try:
            direction = find_direction(evaluation, y, search.lower, search.upper, metric.B, multipliers > 0.0)
        except np.linalg.LinAlgError:  # constraints of very different sizes: the package goes on
            return None
        end = np.clip(y + direction.s, search.lower, search.upper)
        next_evaluation = search.evaluate(end, gradients=True)
        if not next_evaluation.ok:
            return None
        quality = search.kuhn_tucker(next_evaluation, end)
        multipliers = quality.multipliers
        if search.violation(next_evaluation) <= search.feasibility and quality.residual <= kkt:
            search.record(end)
            return end
        gradients = [lagrangian_gradient(e, multipliers) for e in (evaluation, next_evaluation)]
        metric.update(end - y, gradients[1] - gradients[0])
        y, evaluation = end, next_evaluation
    return None


def _run_wrapped(wrapped: WrappedProblem, run: Callable[[WrappedProblem], Stop]) -> Stop | None:
    """Run once; None if the limit of iterations ended it."""
    search = wrapped.search
    try:
        stop = run(wrapped)
        final = search.evaluate(stop.y, gradients=True)
        if final.ok:
            wrapped.record(stop.y)
            return stop
        wrapped.failed.append(stop.y)
        reason = final.status
    except LimitReached:
        return None
    except EvaluationFailed as error:
        reason = str(error)
    assert search.best is not None
    return Stop(search.best, False, f"stopped at a failed evaluation ({reason})")


def _better(search: Search, y: np.ndarray) -> np.ndarray:
    """Return `y`, or the best design seen where that is strictly better."""
    best = search.best
    if best is None or search.rank(search.evaluate(y)) <= search.rank(search.evaluate(best)):
        return y
    return best


def _with_gradient(search: Search, y: np.ndarray, failed: list[np.ndarray]) -> tuple[np.ndarray, Evaluation]:
    """Return `y` with its evaluation, or, where its gradient fails, the best design whose gradient does not."""
    while not (evaluation := search.evaluate(y, gradients=True)).ok:
        failed.append(y)
        assert search.best is not None  # the start, if no other
        y = search.best
    return y, evaluation


def _ending(search: Search, y: np.ndarray, message: str) -> Ending:
    evaluation = search.evaluate(y)
    violation = search.violation(evaluation)
    if violation > search.feasibility:
        violated = search.violated(evaluation)
        return Ending(y, "infeasible", f"{message}; constraints {violated} remain violated by up to {violation:.3g}")
    return Ending(y, "stalled", f"the way down leads into designs that fail; {message}" if search.failures else message)
