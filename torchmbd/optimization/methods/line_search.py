"""The one-dimensional search: how far along a direction, by polynomials through the objective and every constraint.

    phi(alpha) = f + sum_j w_j max(0, c_j)       at P(y + alpha s), P the projection onto the side constraints

f and each c_j are modeled by polynomials through the values and slopes known so far; the next alpha minimizes phi of these
models, at a minimum of the objective or where a constraint becomes violated. A design that violates a curved constraint by
more than its thickness is moved back to the constraint by a step of Newton's method, before a shorter step is tried. A
failed evaluation shortens the step.

Source: Vanderplaats, Numerical Optimization Techniques for Engineering Design (one-dimensional search with
constraints; the return to the constraints in the modified method). That the exact penalty decides is due to Han and Powell,
not to DOT.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.optimization.methods.direction import Direction
from torchmbd.optimization.methods.quadratic import solve_quadratic
from torchmbd.optimization.optimizer import Evaluation
from torchmbd.optimization.search import Search

SUFFICIENT = 1e-2  # share of the decrease to first order that a step must reach
NOISE = 1e-10  # of phi: rise that is allowed to a step that halves the violation
MOST_EVALUATIONS = 12
SHORTEN_FAILED = 0.25  # factor of a step to a failed evaluation
LONGEST_STRETCH = 3.0  # factor of alpha in one extrapolation, at most


@dataclass(frozen=True)
class Trial:
    alpha: float
    y: np.ndarray
    evaluation: Evaluation
    merit: float


@dataclass
class LineSearch:
    """One search from y with evaluation `base` along a direction, with at most MOST_EVALUATIONS."""

    search: Search
    y: np.ndarray
    base: Evaluation
    direction: Direction
    weights: np.ndarray  # [m]
    B: np.ndarray
    unit: np.ndarray  # [m], divisors that make distances of constraints
    slack: float  # distance up to which a violation is left to the next direction

    def __post_init__(self) -> None:
        assert self.base.objective_gradient is not None
        assert self.base.constraint_gradients is not None
        self.df0 = float(self.base.objective_gradient @ self.direction.s)
        self.dc0 = self.base.constraint_gradients @ self.direction.s
        self.merit0 = self.merit(self.base)
        self.thickness = np.maximum(self.search.feasibility, self.slack * self.unit)
        self.worst0 = self.worst(self.base)
        removed = float(self.weights @ np.maximum(self.base.constraints, 0.0)) * self.direction.beta
        self.slope = self.df0 - removed
        self.trials: list[Trial] = []  # that could be evaluated
        self.used = 0
        self.failures = 0
        self.reason = ""
        self.feasible = bool((self.base.constraints <= self.thickness).all())
        self.shortest = 1e-10 * (1.0 + np.abs(self.y).max()) / max(np.abs(self.direction.s).max(initial=0.0), 1e-300)

    def merit(self, evaluation: Evaluation) -> float:
        return evaluation.objective + float(self.weights @ np.maximum(evaluation.constraints, 0.0))

    def run(self, alpha: float, stretch: float) -> Trial | None:
        """Return the best acceptable trial, or None.

        alpha    of the first trial
        stretch  factor by which the model must lengthen alpha before a longer step is tried
        """
        shortened = False
        while not self.used or (self.used < MOST_EVALUATIONS and alpha >= self.shortest):
            trial = self.attempt(self.y + alpha * self.direction.s, alpha)
            if trial is None:
                alpha, shortened = alpha * SHORTEN_FAILED, True
                continue
            if not self.near_feasible(trial):
                returned = self.back_to_constraints(trial)
                if returned is not None and (returned.merit < trial.merit or self.acceptable(returned)):
                    trial = returned
            if self.acceptable(trial):
                return trial if shortened else self.extrapolated(trial, stretch)
            alpha, shortened = self.shorter(trial), True
        return None

    def attempt(self, y: np.ndarray, alpha: float) -> Trial | None:
        """Evaluate a design, projected onto the side constraints; None if that fails."""
        y = np.clip(y, self.search.lower, self.search.upper)
        evaluation = self.search.evaluate(y)
        self.used += 1
        if not evaluation.ok:
            self.failures += 1
            self.reason = evaluation.status
            return None
        trial = Trial(alpha, y, evaluation, self.merit(evaluation))
        self.trials.append(trial)
        return trial

    def near_feasible(self, trial: Trial) -> bool:
        """True if no violation exceeds the thickness of its constraint, or the violation that the direction should leave."""
        before = np.maximum(self.base.constraints, 0.0)
        allowed = np.maximum(self.thickness, (1.0 - 0.5 * self.direction.beta * min(trial.alpha, 1.0)) * before)
        return not np.any(trial.evaluation.constraints > allowed)

    def acceptable(self, trial: Trial) -> bool:
        """True if phi has fallen enough; from a feasible design, only if the trial is feasible."""
        if self.feasible and not self.near_feasible(trial):
            return False
        restored = self.worst(trial.evaluation) < 0.5 * self.worst0
        noise = NOISE * max(1.0, abs(self.merit0)) if restored else 0.0
        return trial.merit <= self.merit0 + SUFFICIENT * min(trial.alpha, 1.0) * self.slope + noise

    def worst(self, evaluation: Evaluation) -> float:
        """Return the largest violation as a distance."""
        return float((np.maximum(evaluation.constraints, 0.0) / self.unit).max(initial=0.0))

    def back_to_constraints(self, trial: Trial) -> Trial | None:
        """Return the trial moved back to the constraints that it violates, by the smallest step in the metric B."""
        known = trial.evaluation.constraint_gradients
        gradients = self.base.constraint_gradients if known is None else known
        assert gradients is not None
        c = trial.evaluation.constraints
        rows = np.flatnonzero((c > 0.0) | (self.direction.multipliers > 0.0))
        bounded_above, bounded_below = np.isfinite(self.search.upper), np.isfinite(self.search.lower)
        identity = np.eye(self.y.size)
        A = np.vstack([gradients[rows], identity[bounded_above], -identity[bounded_below]])
        gaps = ((self.search.upper - trial.y)[bounded_above], (trial.y - self.search.lower)[bounded_below])
        solution = solve_quadratic(self.B, np.zeros(self.y.size), A, np.concatenate([-c[rows], *gaps]))
        if solution is None or np.abs(solution.s).max() > np.abs(trial.y - self.y).max():
            return None
        return self.attempt(trial.y + solution.s, trial.alpha)

    def shorter(self, trial: Trial) -> float:
        """Return the smaller alpha with the lowest phi of the models; from a feasible design, where they are feasible."""
        grid = np.linspace(0.05 * trial.alpha, 0.7 * trial.alpha, 66)
        values, constraints = self.modeled(grid, trial)
        if self.feasible:
            outside = np.any(constraints > self.thickness, axis=1)
            outside[0] = False  # the smallest step of all is always allowed
            values = np.where(outside, np.inf, values)
        return float(grid[np.argmin(values)])

    def extrapolated(self, trial: Trial, stretch: float) -> Trial:
        """Try longer steps while the models expect a much lower phi there."""
        best = trial
        while self.used < MOST_EVALUATIONS:
            grid = np.linspace(best.alpha, LONGEST_STRETCH * best.alpha, 81)
            merits, _ = self.modeled(grid, best)
            choice = int(np.argmin(merits))
            worthwhile = best.merit - merits[choice] > 0.3 * (self.merit0 - best.merit)
            if grid[choice] < stretch * best.alpha or not worthwhile:
                return best
            longer = self.attempt(self.y + grid[choice] * self.direction.s, float(grid[choice]))
            if longer is None or longer.merit >= best.merit or not self.near_feasible(longer):
                return best
            best = longer
        return best

    def modeled(self, grid: np.ndarray, newest: Trial) -> tuple[np.ndarray, np.ndarray]:
        """Return phi [k] and c [k, m] of the polynomial models at the alphas of `grid` [k].

        They meet values and slopes at the start, and at `newest`; without gradients there, the values of the last two trials.
        """
        base, last = self.base, newest.evaluation
        starts, slopes = np.append(base.objective, base.constraints), np.append(self.df0, self.dc0)
        known = [(newest.alpha, 0, np.append(last.objective, last.constraints))]
        if last.objective_gradient is not None and last.constraint_gradients is not None:
            s = self.direction.s * ((newest.y > self.search.lower) & (newest.y < self.search.upper))
            known.append((newest.alpha, 1, np.append(last.objective_gradient @ s, last.constraint_gradients @ s)))
        else:
            others = [t for t in self.trials if abs(t.alpha - newest.alpha) > 1e-9 * newest.alpha]
            known += [(t.alpha, 0, np.append(t.evaluation.objective, t.evaluation.constraints)) for t in others[-1:]]
        values = _polynomial(starts, slopes, known, grid)
        constraints = values[:, 1:]
        return values[:, 0] + np.maximum(constraints, 0.0) @ self.weights, constraints


def _polynomial(
    starts: np.ndarray, slopes: np.ndarray, known: list[tuple[float, int, np.ndarray]], grid: np.ndarray
) -> np.ndarray:
    """Return the values [grid, m] of m polynomials.

    starts, slopes  at 0 [m];  known  (alpha, 0, values [m]) or (alpha, 1, slopes [m]) at further points
    """
    powers = np.arange(2, 2 + len(known))
    rows = [a**powers if order == 0 else powers * a ** (powers - 1) for a, order, _ in known]
    right = [v - starts - a * slopes if order == 0 else v - slopes for a, order, v in known]
    higher = np.linalg.solve(np.array(rows), np.array(right))
    return starts + np.outer(grid, slopes) + grid[:, None] ** powers @ higher
