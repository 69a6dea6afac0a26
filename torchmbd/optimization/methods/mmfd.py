"""The modified method of feasible directions.

Each iteration
1. finds the active (c >= CT) and violated (c > CTMIN) constraints, measured as distances where they are steep;
2. finds a usable-feasible direction, along the active constraints, out of the violated ones (direction.py);
3. searches along it by polynomials, the side constraints by projection, back to curved ones (line_search.py);
4. stops if the objective changed by less than DELOBJ (relative) or DABOBJ (absolute, in units of the start's objective)
   in ITRMOP consecutive iterations, or would not change by more; it has converged if that is a Kuhn-Tucker point.

From a feasible design only designs are accepted that violate no constraint by more than the slack. The slack is CTMIN in
the first iterations and shrinks with the promised gain down to the problem's feasibility tolerance. An infeasible start
becomes feasible first, with the weight Phi on the violation. A failed evaluation shortens the step. Saddle points are left:
the end must be a minimum, not only a Kuhn-Tucker point (curvature.py).

Options have the names of DOT. Differences from DOT: the metric of a direction is updated by every step (direction.py), all
constraints are linearized and not only the active ones, an exact penalty decides in the line search, the tolerances are
tighter (DOT: DELOBJ 1e-3, CTMIN 3e-3 at the end also) and the first step is longer (DOT: DOBJ1 0.1).

Source: Vanderplaats, An efficient feasible directions algorithm for design synthesis, AIAA J. 22 (1984) 1633-1640;
Vanderplaats, Numerical Optimization Techniques for Engineering Design; DOT user's manual (options and criteria). Own
text throughout. Checked in tests/contracts/test_optimizers.py and tests/optimization/test_counts.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.errors import true_or_false
from torchmbd.optimization.curvature import perturb_stationary_start, reduced_hessian, tangent_basis
from torchmbd.optimization.kkt import KuhnTucker
from torchmbd.optimization.methods.direction import Direction, VariableMetric, find_direction
from torchmbd.optimization.methods.line_search import LineSearch, Trial
from torchmbd.optimization.optimizer import Ending, Evaluation, register, require_count, require_range
from torchmbd.optimization.search import Search

# Longest change of a variable in the next step, as a multiple of that in the last step: if this was shortened, or a full step.
GROWTH_IF_SHORTENED, GROWTH_IF_FULL = 3.0, 10.0
# Times ITRMOP: iterations without progress that are allowed while a constraint or the Kuhn-Tucker conditions are violated.
PATIENCE = 5
RESETS = 2  # resets of the metric, at most
ESCAPE = 0.25  # length of a step away from a saddle point (scaled)
AT_REST = (
    0.1  # times the option kkt: residual below which an objective that no longer changes is optimal without a reset
)
NO_KUHN_TUCKER = "the Kuhn-Tucker conditions do not hold"


@dataclass(frozen=True)
class Settings:
    """The options of `mmfd`."""

    ct: float
    ctmin: float
    delobj: float
    dabobj: float
    itrmop: int
    dobj1: float
    dx1: float
    kkt: float
    second_order: bool


class FeasibleDirections:
    """One run: the current design `y` (scaled) with its `evaluation`, the metric, penalty weights and step limits."""

    def __init__(self, search: Search, settings: Settings, first: Evaluation) -> None:
        self.search, self.settings, self.metric = search, settings, VariableMetric(search.size)
        self.y, self.evaluation = perturb_stationary_start(search, first)
        self.weights = np.zeros(self.evaluation.constraints.size)  # of the exact penalty
        self.resets = 0
        self.resting = 0  # iterations in which the objective has not changed
        self.max_change = np.inf  # of a variable in one step (scaled)
        self.metric.reset(self.first_curvature(self.weights))

    def run(self, max_iterations: int) -> Ending:
        """Iterate until the run ends; leave saddle points."""
        for _ in range(max_iterations):
            ending = self.iterate()
            if ending is not None and not (ending.status == "converged" and self.escape_saddle()):
                return ending
        return Ending(self.y, "max_iterations", f"{max_iterations} iterations were not enough to converge")

    def iterate(self) -> Ending | None:
        """Make one step."""
        direction = self.find_direction()
        ending = self.check_optimality(direction)
        if ending is not None:
            return ending
        line = self.line_search(direction)
        trial = line.run(1.0, self.metric.stretch)
        if trial is None or not (trial.y != self.y).any():
            return self.without_step(direction, line)
        return self.accept(direction, trial, line)

    def find_direction(self) -> Direction:
        """Return the direction to search along, within bounds and `max_change`."""
        active = self.evaluation.constraints >= self.settings.ct * self.constraint_units()
        lower = np.maximum(self.search.lower, self.y - self.max_change)
        upper = np.minimum(self.search.upper, self.y + self.max_change)
        direction = find_direction(self.evaluation, self.y, lower, upper, self.metric.B, active)
        if direction.beta == 1.0 and np.abs(direction.s).max(initial=0.0) >= 0.999 * self.max_change:
            # At the limit of the step the multipliers of constraints are too small: those at the design are better.
            multipliers = np.maximum(direction.multipliers, self.multiplier_estimate().multipliers)
            direction = Direction(direction.s, multipliers, direction.beta)
        return direction

    def constraint_units(self) -> np.ndarray:
        """Return the divisors [m] that make distances of constraints: the lengths of their gradients, at least 1."""
        assert self.evaluation.constraint_gradients is not None
        return np.maximum(1.0, np.sqrt((self.evaluation.constraint_gradients**2).sum(axis=1)))

    def expected_decrease(self, direction: Direction) -> float:
        """Return the decrease along the direction, to first order, of the objective and of constraints times multipliers."""
        assert self.evaluation.objective_gradient is not None
        along = abs(float(self.evaluation.objective_gradient @ direction.s))
        return along + float(direction.multipliers @ np.abs(self.evaluation.constraints))

    @property
    def negligible(self) -> float:
        """The change of the objective up to which it counts as unchanged."""
        return max(self.settings.dabobj, self.settings.delobj * abs(self.evaluation.objective))

    def multiplier_estimate(self) -> KuhnTucker:
        """Return multipliers and Kuhn-Tucker residual at the current design; they do not depend on the metric."""
        return self.search.kuhn_tucker(self.evaluation, self.y)

    def check_optimality(self, direction: Direction) -> Ending | None:
        """Return the ending if the direction gains nothing and the Kuhn-Tucker conditions hold; else None."""
        if self.search.violation(self.evaluation) > self.search.feasibility:
            return None
        if np.abs(direction.s).max(initial=0.0) >= 0.999 * self.max_change:  # shortened by the limit
            return None
        if self.expected_decrease(direction) > 0.3 * self.negligible:
            return None
        if self.multiplier_estimate().residual > self.settings.kkt:
            return None
        return Ending(self.y, "converged", "the Kuhn-Tucker conditions hold")

    def line_search(self, direction: Direction) -> LineSearch:
        """Return the line search along the direction, with a slack of constraints in proportion to the expected decrease."""
        search, settings = self.search, self.settings
        slack = min(settings.ctmin, 0.1 * self.expected_decrease(direction))
        self.weights = penalty(self.weights, direction, self.evaluation, self.metric.B)
        return LineSearch(
            search,
            self.y,
            self.evaluation,
            direction,
            self.weights,
            self.metric.B,
            self.constraint_units(),
            slack,
        )

    def accept(self, direction: Direction, trial: Trial, line: LineSearch) -> Ending | None:
        """Move to the trial and update the metric; return an ending if the objective no longer changes."""
        search, before = self.search, self.evaluation
        after = search.evaluate(trial.y, gradients=True)
        if not after.ok:
            return Ending(
                self.y, "failed", f"the gradient could not be evaluated where the values could: {after.status}"
            )
        df, dc = before.objective_gradient, before.constraint_gradients
        assert df is not None
        assert dc is not None
        assert after.objective_gradient is not None
        assert after.constraint_gradients is not None
        q = after.objective_gradient - df + (after.constraint_gradients - dc).T @ direction.multipliers
        step = trial.y - self.y
        self.metric.update(step, q)
        self.update_max_change(trial.alpha, step, direction)
        self.y, self.evaluation = trial.y, after
        search.record(self.y)
        self.resting = self.resting + 1 if abs(after.objective - before.objective) <= self.negligible else 0
        return self.judge_rest(direction, line) if self.resting >= self.settings.itrmop else None

    def update_max_change(self, alpha: float, step: np.ndarray, direction: Direction) -> None:
        """Set the limit of the next step by the last one."""
        length = float(np.abs(step).max())
        if alpha < 1.0:
            self.max_change = GROWTH_IF_SHORTENED * length
        elif float(np.abs(direction.s).max()) >= 0.9 * self.max_change:
            self.max_change *= GROWTH_IF_FULL

    def judge_rest(self, direction: Direction, line: LineSearch) -> Ending | None:
        """Return the ending of a run whose objective no longer changes, None if it goes on."""
        search = self.search
        if search.violation(self.evaluation) > search.feasibility:
            if self.resting < PATIENCE * self.settings.itrmop:
                return None
            return self.without_step(direction, line)
        if line.failures:  # steps this short are no sign of an optimum
            return Ending(self.y, "stalled", f"the way down leads into designs that fail: {line.reason}")
        residual = self.multiplier_estimate().residual
        if residual > AT_REST * self.settings.kkt and self.reset_metric(direction):
            return None
        if residual > self.settings.kkt and self.resting < PATIENCE * self.settings.itrmop:
            return None
        if residual <= self.settings.kkt:
            return Ending(self.y, "converged", f"the objective no longer changes ({self.resting} iterations)")
        return Ending(self.y, "stalled", f"the objective no longer changes, though {NO_KUHN_TUCKER}: a kink?")

    def escape_saddle(self) -> bool:
        """Step along negative curvature if the current Kuhn-Tucker point is not a minimum; return whether a step was made."""
        if not self.settings.second_order:
            return False
        estimate, search = self.multiplier_estimate(), self.search
        Z = tangent_basis(self.evaluation, estimate, self.settings.kkt, search.equality)
        reduced = reduced_hessian(search, self.y, self.evaluation, estimate.multipliers, Z)
        if reduced is None or not reduced.size:
            return False
        values, vectors = np.linalg.eigh(reduced)
        if -values[0] * ESCAPE**2 <= self.negligible:
            return False
        s = Z @ vectors[:, 0]
        self.metric.set_hessian(Z @ reduced @ Z.T + values[-1] * (np.eye(len(Z)) - Z @ Z.T))
        s *= ESCAPE / np.abs(s).max()
        both = [np.clip(self.y + sign * s, search.lower, search.upper) for sign in (1.0, -1.0)]
        search.prefetch(both)
        for sign in (1.0, -1.0):
            direction = Direction(sign * s, estimate.multipliers, 1.0)
            line = self.line_search(direction)
            trial = line.run(1.0, np.inf)
            gain = 0.0 if trial is None else self.evaluation.objective - trial.evaluation.objective
            if trial is not None and gain > self.negligible:
                self.resting = 0
                self.max_change = max(self.max_change, ESCAPE)
                return self.accept(direction, trial, line) is None
        return False

    def without_step(self, direction: Direction, line: LineSearch) -> Ending | None:
        """Return the ending where no step was found, None after a reset of the metric that may find one."""
        violation = self.search.violation(self.evaluation)
        feasible = violation <= self.search.feasibility
        small = self.expected_decrease(direction) <= 10.0 * self.negligible
        if feasible and small and self.multiplier_estimate().residual <= self.settings.kkt:
            return Ending(self.y, "converged", "the Kuhn-Tucker conditions hold to the precision of the evaluations")
        if self.reset_metric(direction):
            return None
        if line.failures and line.failures == line.used:
            return Ending(self.y, "stalled", f"every design tried around x failed: {line.reason}")
        if feasible:
            return Ending(self.y, "stalled", f"no step lowers the objective, though {NO_KUHN_TUCKER}: a kink?")
        conflicting = np.flatnonzero(direction.multipliers > 1e-3 * direction.multipliers.max(initial=0.0))
        return Ending(
            self.y,
            "infeasible",
            f"the violation {violation:.3g} cannot be reduced to first order: constraints {conflicting.tolist()} "
            "contradict each other or the bounds",
        )

    def reset_metric(self, direction: Direction) -> bool:
        """Reset the metric and the limit of the step; return False after RESETS of them."""
        if self.resets >= RESETS:
            return False
        self.resets += 1
        self.resting = 0
        self.max_change = np.inf
        self.metric.reset(self.first_curvature(direction.multipliers))
        return True

    def first_curvature(self, multipliers: np.ndarray) -> float:
        """Return the curvature with which the first step changes objective and variables by DOBJ1 and DX1 at most."""
        df, dc = self.evaluation.objective_gradient, self.evaluation.constraint_gradients
        assert df is not None
        assert dc is not None
        slope = df + dc.T @ multipliers
        outward = (self.y <= self.search.lower) & (slope > 0.0) | (self.y >= self.search.upper) & (slope < 0.0)
        slope = np.where(outward, 0.0, slope)
        largest = np.abs(slope).max(initial=0.0)
        if largest == 0.0:
            return 1.0
        step = self.settings.dx1 * max(float(np.abs(self.y).max()), 0.1) / largest
        if self.evaluation.objective != 0.0:
            step = min(step, self.settings.dobj1 * abs(self.evaluation.objective) / float(slope @ slope))
        return 1.0 / step


def penalty(weights: np.ndarray, direction: Direction, evaluation: Evaluation, B: np.ndarray) -> np.ndarray:
    """Return the weights of the exact penalty [m]: the multipliers, or the mean of these and the last weights (Powell)."""
    if direction.beta == 1.0:
        return np.maximum(direction.multipliers, 0.5 * (weights + direction.multipliers))
    # The multipliers of a relaxed subproblem are of the order of Phi: take weights for which the penalty descends instead.
    assert evaluation.objective_gradient is not None
    removed = direction.beta * float(np.maximum(evaluation.constraints, 0.0).sum())
    rise = float(evaluation.objective_gradient @ direction.s + 0.5 * direction.s @ B @ direction.s)
    needed = 2.0 * max(rise, 0.0) / removed if removed > 0.0 else 0.0
    return np.maximum(0.5 * weights, needed)


@register("mmfd", dense=True)
def mmfd(
    search: Search,
    max_iterations: int,
    *,
    ct: float = -0.03,
    ctmin: float = 0.003,
    delobj: float = 1e-6,
    dabobj: float = 1e-8,
    itrmop: int = 2,
    dobj1: float = 0.5,
    dx1: float = 1.0,
    kkt: float = 1e-3,
    second_order: bool = True,
) -> Ending:
    """Run the method on one start.

    `dobj1`, `dx1`: share of objective and variables that the first step may change. `kkt`: Kuhn-Tucker residual of an
    optimum. `second_order`: leave saddle points;
    the check takes one analysis for each direction along the active constraints, in one batch.
    """
    require_range("ct", ct, -1.0, 0.0)
    positive = {"ctmin": ctmin, "delobj": delobj, "dabobj": dabobj, "dobj1": dobj1, "dx1": dx1, "kkt": kkt}
    for name, value in positive.items():
        require_range(name, value, 1e-16, 1e3)
    require_count("itrmop", itrmop, 1, 1000)
    second_order = true_or_false("second_order", second_order)
    search.refuse_equalities("mmfd")
    first = search.begin()
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    settings = Settings(ct, ctmin, delobj, dabobj, itrmop, dobj1, dx1, kkt, second_order)
    return FeasibleDirections(search, settings, first).run(max_iterations)
