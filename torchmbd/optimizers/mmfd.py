"""The modified method of feasible directions.

Each iteration
1. finds the active (c >= CT) and violated (c > CTMIN) constraints, measured as distances where they are steep;
2. finds a usable-feasible direction, along the active constraints, out of the violated ones (direction.py);
3. searches along it by polynomials, the side constraints by projection, back to curved ones (line_search.py);
4. stops at a Kuhn-Tucker point, or if the objective changed by less than DELOBJ (relative) or DABOBJ (absolute, in
   units of the start's objective) in ITRMOP consecutive iterations.

From a feasible design only feasible designs are accepted: whenever it is stopped, the last iterate can be built.
CTMIN is the slack of the first iterations and shrinks with the promised gain down to the problem's feasibility
tolerance. An infeasible start is restored first, with the weight Phi on the violation. A failed evaluation shortens
the step.

Options have the names of DOT. What differs from DOT: the metric is learnt (`metric="bfgs"`; "conjugate" is DOT's:
steepest descent or Fletcher-Reeves, projected), all constraints are linearized and not only the active, an exact
penalty arbitrates the line search, the tolerances are tighter (DOT: DELOBJ 1e-3, CTMIN 3e-3 at the end also) and the
first step bolder (DOT: DOBJ1 0.1).

Source: Vanderplaats, An efficient feasible directions algorithm for design synthesis, AIAA J. 22 (1984) 1633-1640;
Vanderplaats, Numerical Optimization Techniques for Engineering Design; DOT user's manual (options and criteria). Own
text throughout. Checked in tests/contracts/test_optimizers.py and tests/optimizers/test_counts.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.errors import unknown
from torchmbd.optimizers.direction import Direction, find_direction
from torchmbd.optimizers.kkt import kuhn_tucker
from torchmbd.optimizers.line_search import LineSearch, Trial
from torchmbd.optimizers.metric import METRICS, Metric
from torchmbd.optimizers.optimizer import Ending, Evaluation, refuse_equalities, register, require_range
from torchmbd.optimizers.search import Search
from torchmbd.optimizers.stationary import departure

PATIENCE = 5  # times ITRMOP iterations at rest may go on while a constraint is still violated
RESETS = 2  # fresh starts of the metric before the search gives up
REACH_AFTER, REACH_GROWS = 3.0, 10.0  # times the step just made: after a shortened one, after a full one
LOOSE = 2e-2  # Kuhn-Tucker residual up to which an objective at rest is believed to be optimal
NO_KUHN_TUCKER = "the Kuhn-Tucker conditions do not hold"
SMALLEST_OBJECTIVE = 1e-3  # of the start's: below this, relative criteria become absolute


@dataclass(frozen=True)
class Settings:
    ct: float
    ctmin: float
    delobj: float
    dabobj: float
    itrmop: int
    dobj1: float
    dx1: float
    kkt: float


@register("mmfd")
def mmfd(
    search: Search,
    max_iterations: int,
    *,
    metric: str = "bfgs",
    ct: float = -0.03,
    ctmin: float = 0.003,
    delobj: float = 1e-6,
    dabobj: float = 1e-8,
    itrmop: int = 2,
    dobj1: float = 0.5,
    dx1: float = 1.0,
    kkt: float = 1e-3,
) -> Ending:
    """Run the method on one start; `dobj1`, `dx1`: share of objective and variables that the first step may change."""
    if metric not in METRICS:
        raise unknown("metric", metric, METRICS)
    require_range("ct", ct, -1.0, 0.0)
    positive = {"ctmin": ctmin, "delobj": delobj, "dabobj": dabobj, "dobj1": dobj1, "dx1": dx1, "kkt": kkt}
    for name, value in positive.items():
        require_range(name, value, 1e-16, 1e3)
    require_range("itrmop", itrmop, 1, 1000)
    refuse_equalities("mmfd", search)
    first = search.begin()
    if not first.ok:
        return Ending(search.start, "failed", f"the start could not be evaluated: {first.status}")
    settings = Settings(ct, ctmin, delobj, dabobj, itrmop, dobj1, dx1, kkt)
    return FeasibleDirections(search, settings, METRICS[metric](search.size), first).run(max_iterations)


class FeasibleDirections:
    """One run: the current design `y`, its evaluation `here`, and what was learnt on the way."""

    def __init__(self, search: Search, settings: Settings, metric: Metric, first: Evaluation) -> None:
        self.search, self.settings, self.metric = search, settings, metric
        self.y, self.here = departure(search, first)
        self.weights = np.zeros(self.here.constraints.size)
        self.resets = self.quiet = 0
        self.reach = np.inf  # longest step of a variable, once a step proved too long
        self.metric.reset(self.first_curvature(self.weights))

    def run(self, max_iterations: int) -> Ending:
        for _ in range(max_iterations):
            direction = self.direction()
            ending = self.kuhn_tucker(direction)
            if ending is not None:
                return ending
            line = self.line(direction)
            trial = line.run(1.0, self.metric.stretch, self.metric.refine)
            if trial is None or not (trial.y != self.y).any():
                ending = self.no_step(direction, line)
                if ending is not None:
                    return ending
                continue
            ending = self.accept(direction, trial, line)
            if ending is not None:
                return ending
        return Ending(self.y, "max_iterations", f"{max_iterations} iterations were not enough to converge")

    def direction(self) -> Direction:
        search, c = self.search, self.here.constraints
        active = c >= self.settings.ct * self.unit()
        lower, upper = np.maximum(search.lower, self.y - self.reach), np.minimum(search.upper, self.y + self.reach)
        direction = find_direction(self.here, self.y, lower, upper, self.metric.B, active)
        df = self.here.objective_gradient
        assert df is not None
        bounded = np.abs(self.metric.B @ direction.s + df).max(initial=0.0) > 1e-6 * np.abs(df).max(initial=0.0)
        free = not bounded and not direction.multipliers.any()
        return Direction(self.metric.turn(direction, self.here, free), direction.multipliers, direction.beta)

    def unit(self) -> np.ndarray:
        """Return what makes a distance of each constraint [m]: its gradient's length where that exceeds one."""
        assert self.here.constraint_gradients is not None
        return np.maximum(1.0, np.sqrt((self.here.constraint_gradients**2).sum(axis=1)))

    def promise(self, direction: Direction) -> float:
        """Return by how much the objective should fall along the direction, constraints weighed by multipliers."""
        assert self.here.objective_gradient is not None
        along = abs(float(self.here.objective_gradient @ direction.s))
        return along + float(direction.multipliers @ np.abs(self.here.constraints))

    @property
    def negligible(self) -> float:
        """The change of the objective that ITRMOP iterations must not exceed."""
        return max(self.settings.dabobj, self.settings.delobj * abs(self.here.objective))

    def remainder(self, direction: Direction) -> float:
        """Return the Lagrangian's gradient times the variables' size, relative to the objective: 0 at the optimum."""
        rest = np.abs(self.metric.B @ direction.s) * np.maximum(np.abs(self.y), 1.0)
        return float(rest.max(initial=0.0)) / max(abs(self.here.objective), SMALLEST_OBJECTIVE)

    def kuhn_tucker(self, direction: Direction) -> Ending | None:
        if self.search.violation(self.here) > self.search.feasibility:
            return None
        if np.abs(direction.s).max(initial=0.0) >= 0.999 * self.reach:
            return None
        if self.promise(direction) > 0.3 * self.negligible or self.remainder(direction) > self.settings.kkt:
            return None
        return Ending(self.y, "converged", "the Kuhn-Tucker conditions hold")

    def line(self, direction: Direction) -> LineSearch:
        search, settings = self.search, self.settings
        slack = min(settings.ctmin, 0.1 * self.promise(direction)) * self.unit()
        self.weights = penalty(self.weights, direction, self.here, self.metric.B)
        thickness = np.maximum(search.feasibility, slack)
        return LineSearch(search, self.y, self.here, direction, self.weights, self.metric.B, thickness)

    def accept(self, direction: Direction, trial: Trial, line: LineSearch) -> Ending | None:
        """Move to the trial and learn from the step; an Ending if the design or its numbers no longer change."""
        search, before = self.search, self.here
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
        self.metric.learn(step, q)
        if trial.alpha < 1.0:
            self.reach = REACH_AFTER * float(np.abs(step).max())
        else:
            self.reach *= REACH_GROWS
        self.y, self.here = trial.y, after
        search.record(self.y)
        self.quiet = self.quiet + 1 if abs(after.objective - before.objective) <= self.negligible else 0
        return self.at_rest(direction, line) if self.quiet >= self.settings.itrmop else None

    def at_rest(self, direction: Direction, line: LineSearch) -> Ending | None:
        """Say what it means that the objective no longer changes, or None to go on."""
        search = self.search
        if search.violation(self.here) > search.feasibility:
            patient = self.quiet < PATIENCE * self.settings.itrmop
            return None if patient else self.no_step(direction, line)
        if line.failures:  # steps this short are no sign of an optimum
            return Ending(self.y, "stalled", f"the way down leads into designs that fail: {line.reason}")
        quality = kuhn_tucker(self.here, self.y, search.lower, search.upper, search.equality)
        if quality.residual <= LOOSE:
            return Ending(self.y, "converged", f"the objective no longer changes ({self.quiet} iterations)")
        if self.afresh(direction):
            return None
        return Ending(self.y, "stalled", f"the objective no longer changes, though {NO_KUHN_TUCKER}: a kink?")

    def no_step(self, direction: Direction, line: LineSearch) -> Ending | None:
        """Say why no step was found, or None after a fresh start of the metric that may find one."""
        violation = self.search.violation(self.here)
        feasible = violation <= self.search.feasibility
        precise = self.promise(direction) <= 10.0 * self.negligible and self.remainder(direction) <= self.settings.kkt
        if feasible and precise:
            return Ending(self.y, "converged", "the Kuhn-Tucker conditions hold to the precision of the evaluations")
        if self.afresh(direction):
            return None
        if line.failures and line.failures == line.used:
            return Ending(self.y, "stalled", f"every design tried around x failed: {line.reason}")
        if feasible:
            return Ending(self.y, "stalled", f"no step lowers the objective, though {NO_KUHN_TUCKER}: a kink?")
        fighting = np.flatnonzero(direction.multipliers > 1e-3 * direction.multipliers.max(initial=0.0))
        return Ending(
            self.y,
            "infeasible",
            f"the violation {violation:.3g} cannot be reduced to first order: constraints {fighting.tolist()} "
            "contradict each other or the bounds",
        )

    def afresh(self, direction: Direction) -> bool:
        """Forget what was learnt and go on; False if that has been done often enough."""
        if self.resets >= RESETS:
            return False
        self.resets += 1
        self.quiet = 0
        self.reach = np.inf
        self.metric.reset(self.first_curvature(direction.multipliers))
        return True

    def first_curvature(self, multipliers: np.ndarray) -> float:
        """Return the curvature for which the first step changes objective and variables by DOBJ1 and DX1 at most."""
        df, dc = self.here.objective_gradient, self.here.constraint_gradients
        assert df is not None
        assert dc is not None
        slope = df + dc.T @ multipliers
        outward = (self.y <= self.search.lower) & (slope > 0.0) | (self.y >= self.search.upper) & (slope < 0.0)
        slope = np.where(outward, 0.0, slope)
        largest = np.abs(slope).max(initial=0.0)
        if largest == 0.0:
            return 1.0
        step = self.settings.dx1 * max(float(np.abs(self.y).max()), 0.1) / largest
        if self.here.objective != 0.0:
            step = min(step, self.settings.dobj1 * abs(self.here.objective) / float(slope @ slope))
        return 1.0 / step


def penalty(weights: np.ndarray, direction: Direction, here: Evaluation, B: np.ndarray) -> np.ndarray:
    """Return the weights of the exact penalty: not below the multipliers, forgetting old ones by halves (Powell)."""
    if direction.beta == 1.0:
        return np.maximum(direction.multipliers, 0.5 * (weights + direction.multipliers))
    # The multipliers of a relaxed subproblem are of the order of Phi: take what makes the direction one of descent
    # instead.
    assert here.objective_gradient is not None
    removed = direction.beta * float(np.maximum(here.constraints, 0.0).sum())
    rise = float(here.objective_gradient @ direction.s + 0.5 * direction.s @ B @ direction.s)
    needed = 2.0 * max(rise, 0.0) / removed if removed > 0.0 else 0.0
    return np.maximum(0.5 * weights, needed)
