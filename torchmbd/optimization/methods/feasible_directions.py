"""The iterations of the modified method of feasible directions; mmfd.py tells the method and its options."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.curvature import reduced_hessian, tangent_basis
from torchmbd.optimization.kkt import KuhnTucker, kuhn_tucker
from torchmbd.optimization.methods.direction import Direction, find_direction
from torchmbd.optimization.methods.line_search import LineSearch, Trial
from torchmbd.optimization.methods.metric import VariableMetric
from torchmbd.optimization.optimizer import Ending, Evaluation
from torchmbd.optimization.search import Search
from torchmbd.optimization.stationary import perturb_stationary_start

# Longest change of a variable in one step, times the step just made: after one cut short, and after a full one of that length.
REACH_IF_SHORT, REACH_IF_FULL = 3.0, 10.0
PATIENCE = 5  # times ITRMOP iterations at rest may go on while a constraint is still violated
RESETS = 2  # fresh starts of the metric before the search gives up
ESCAPE = 0.25  # length of a step away from a saddle point (scaled)
AT_REST = 0.1  # of the option kkt: a residual that needs no second look where the objective is at rest
LOOSE = 2e-2  # Kuhn-Tucker residual up to which an objective at rest is believed to be optimal
NO_KUHN_TUCKER = "the Kuhn-Tucker conditions do not hold"


@dataclass(frozen=True)
class Settings:
    """The options of mmfd.py."""

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
    """One run: the current design `y`, its evaluation `here`, and what was learnt on the way."""

    def __init__(self, search: Search, settings: Settings, first: Evaluation) -> None:
        self.search, self.settings, self.metric = search, settings, VariableMetric(search.size)
        self.y, self.here = perturb_stationary_start(search, first)
        self.weights = np.zeros(self.here.constraints.size)
        self.resets = self.quiet = 0
        self.believed = np.inf  # the objective where it was at rest, and nearly optimal
        self.reach = np.inf  # longest change of a variable in one step (scaled)
        self.metric.reset(self.first_curvature(self.weights))

    def run(self, max_iterations: int) -> Ending:
        """Iterate until an ending is found; one at a saddle point is none."""
        for _ in range(max_iterations):
            ending = self.iterate()
            if ending is not None and not (ending.status == "converged" and self.escaped()):
                return ending
        return Ending(self.y, "max_iterations", f"{max_iterations} iterations were not enough to converge")

    def iterate(self) -> Ending | None:
        """Make one step."""
        direction = self.direction()
        ending = self.kuhn_tucker(direction)
        if ending is not None:
            return ending
        line = self.line(direction)
        trial = line.run(1.0, self.metric.stretch)
        if trial is None or not (trial.y != self.y).any():
            return self.no_step(direction, line)
        return self.accept(direction, trial, line)

    def direction(self) -> Direction:
        """Return the direction to search along, within reach."""
        search, active = self.search, self.here.constraints >= self.settings.ct * self.unit()
        lower, upper = np.maximum(search.lower, self.y - self.reach), np.minimum(search.upper, self.y + self.reach)
        direction = find_direction(self.here, self.y, lower, upper, self.metric.B, active)
        if direction.beta == 1.0 and np.abs(direction.s).max(initial=0.0) >= 0.999 * self.reach:
            # Our own limit takes the multipliers of the constraints upon itself: those of the design tell more.
            multipliers = np.maximum(direction.multipliers, self.quality().multipliers)
            direction = Direction(direction.s, multipliers, direction.beta)
        return direction

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

    def quality(self) -> KuhnTucker:
        """Return multipliers and Kuhn-Tucker residual here, which know nothing of the metric."""
        search = self.search
        return kuhn_tucker(self.here, self.y, search.lower, search.upper, search.equality)

    def kuhn_tucker(self, direction: Direction) -> Ending | None:
        """Return the ending if the direction promises nothing, and the Lagrangian's gradient vanishes indeed."""
        if self.search.violation(self.here) > self.search.feasibility:
            return None
        if np.abs(direction.s).max(initial=0.0) >= 0.999 * self.reach:  # short by our own limit
            return None
        if self.promise(direction) > 0.3 * self.negligible or self.quality().residual > self.settings.kkt:
            return None
        return Ending(self.y, "converged", "the Kuhn-Tucker conditions hold")

    def line(self, direction: Direction) -> LineSearch:
        """Return the line search along the direction, with as much slack for the constraints as the gain is worth."""
        search, settings = self.search, self.settings
        slack = min(settings.ctmin, 0.1 * self.promise(direction))
        self.weights = penalty(self.weights, direction, self.here, self.metric.B)
        return LineSearch(
            search,
            self.y,
            self.here,
            direction,
            self.weights,
            self.metric.B,
            self.unit(),
            slack,
        )

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
        self.extend(trial.alpha, step, direction)
        self.y, self.here = trial.y, after
        search.record(self.y)
        self.quiet = self.quiet + 1 if abs(after.objective - before.objective) <= self.negligible else 0
        return self.at_rest(direction, line) if self.quiet >= self.settings.itrmop else None

    def extend(self, alpha: float, step: np.ndarray, direction: Direction) -> None:
        """Set the reach of the next step by how this one went."""
        length = float(np.abs(step).max())
        if alpha < 1.0:
            self.reach = REACH_IF_SHORT * length
        elif float(np.abs(direction.s).max()) >= 0.9 * self.reach:
            self.reach *= REACH_IF_FULL

    def at_rest(self, direction: Direction, line: LineSearch) -> Ending | None:
        """Say what it means that the objective no longer changes, or None to go on."""
        search = self.search
        if search.violation(self.here) > search.feasibility:
            patient = self.quiet < PATIENCE * self.settings.itrmop
            return None if patient else self.no_step(direction, line)
        if line.failures:  # steps this short are no sign of an optimum
            return Ending(self.y, "stalled", f"the way down leads into designs that fail: {line.reason}")
        residual = self.quality().residual
        if residual <= LOOSE:
            self.believed = self.here.objective
        if residual > AT_REST * self.settings.kkt and self.afresh(direction):
            return None
        if self.here.objective >= self.believed - 10.0 * self.negligible:  # since then nothing came of a fresh start
            return Ending(self.y, "converged", f"the objective no longer changes ({self.quiet} iterations)")
        return Ending(self.y, "stalled", f"the objective no longer changes, though {NO_KUHN_TUCKER}: a kink?")

    def escaped(self) -> bool:
        """Whether this Kuhn-Tucker point is no minimum, and a step along its negative curvature was made."""
        if not self.settings.second_order:
            return False
        quality, search = self.quality(), self.search
        assert self.here.constraint_gradients is not None
        Z = tangent_basis(self.here.constraint_gradients, quality, self.settings.kkt)
        reduced = reduced_hessian(search, self.y, self.here, quality.multipliers, Z)
        if reduced is None or not reduced.size:
            return False
        values, vectors = np.linalg.eigh(reduced)
        if -values[0] * ESCAPE**2 <= self.negligible:
            return False
        s = Z @ vectors[:, 0]
        self.metric.know(Z @ reduced @ Z.T + values[-1] * (np.eye(len(Z)) - Z @ Z.T))
        s *= ESCAPE / np.abs(s).max()
        both = [np.clip(self.y + sign * s, search.lower, search.upper) for sign in (1.0, -1.0)]
        search.prefetch(both)
        for sign in (1.0, -1.0):
            direction = Direction(sign * s, quality.multipliers, 1.0)
            line = self.line(direction)
            trial = line.run(1.0, np.inf)
            gain = 0.0 if trial is None else self.here.objective - trial.evaluation.objective
            if trial is not None and gain > self.negligible:
                self.quiet = 0
                self.reach = max(self.reach, ESCAPE)
                return self.accept(direction, trial, line) is None
        return False

    def no_step(self, direction: Direction, line: LineSearch) -> Ending | None:
        """Say why no step was found, or None after a fresh start of the metric that may find one."""
        violation = self.search.violation(self.here)
        feasible = violation <= self.search.feasibility
        precise = self.promise(direction) <= 10.0 * self.negligible and self.quality().residual <= self.settings.kkt
        if feasible and precise:
            return Ending(self.y, "converged", "the Kuhn-Tucker conditions hold to the precision of the evaluations")
        if self.afresh(direction):
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
