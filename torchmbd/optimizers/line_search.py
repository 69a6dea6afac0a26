"""The one-dimensional search: how far along a direction, by polynomials through the objective and every constraint.

    phi(alpha) = f + sum_j w_j max(0, c_j)       at P(y + alpha s), P the projection onto the side constraints

Polynomials through the values known so far and the slope at alpha = 0 stand for f and for each c_j; the next alpha minimizes phi
made of them, so that a constraint about to be crossed and a minimum of the objective are found by the same rule. A step that ends
beyond the thickness of a curved constraint is returned to it by Newton's method with the gradients at hand, before it is given up.
A failed evaluation shortens the step.

Source: Vanderplaats, Numerical Optimization Techniques for Engineering Design (one-dimensional search with constraints; the
return to the constraints in the modified method); the exact penalty as arbiter is Han's and Powell's, not DOT's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.optimizers.direction import Direction
from torchmbd.optimizers.optimizer import Evaluation
from torchmbd.optimizers.quadratic import solve_quadratic
from torchmbd.optimizers.search import Search

SUFFICIENT = 1e-2  # share of the promised decrease that a step must bring
NOISE = 1e-10  # of phi: below this a step counts by the violation that it removes
SHORTEN_FAILED = 0.25  # a step to a failed evaluation is cut to this
LONGEST_STRETCH = 5.0  # one extrapolation goes at most this much farther


@dataclass(frozen=True)
class Trial:
    alpha: float
    y: np.ndarray
    evaluation: Evaluation
    merit: float


@dataclass
class LineSearch:
    """One search from (y, base) along a direction; `trials` ends with at most `most` evaluations."""

    search: Search
    y: np.ndarray
    base: Evaluation
    direction: Direction
    weights: np.ndarray  # [m]
    B: np.ndarray
    thickness: np.ndarray  # [m], violations up to here are left to the next direction
    most: int = 12

    def __post_init__(self) -> None:
        assert self.base.objective_gradient is not None and self.base.constraint_gradients is not None
        self.df0 = float(self.base.objective_gradient @ self.direction.s)
        self.dc0 = self.base.constraint_gradients @ self.direction.s
        self.merit0 = self.merit(self.base)
        removed = self.weights @ np.maximum(self.base.constraints, 0.0) * self.direction.beta
        self.slope = self.df0 - removed
        self.trials: list[Trial] = []
        self.used = 0
        self.failures = 0
        self.reason = ""
        self.feasible = bool((self.base.constraints <= self.thickness).all())
        self.shortest = 1e-10 * (1.0 + np.abs(self.y).max()) / max(np.abs(self.direction.s).max(initial=0.0), 1e-300)

    def merit(self, evaluation: Evaluation) -> float:
        return evaluation.objective + float(self.weights @ np.maximum(evaluation.constraints, 0.0))

    def run(self, alpha: float, stretch: float, refine: bool = False) -> Trial | None:
        """Return the best acceptable trial, or None.

        `stretch`: an extrapolation must promise an alpha so many times longer. `refine`: interpolate once more even so.
        """
        shortened = False
        while not self.used or (self.used < self.most and alpha >= self.shortest):
            trial = self.attempt(self.y + alpha * self.direction.s, alpha)
            if trial is None:
                alpha, shortened = alpha * SHORTEN_FAILED, True
                continue
            if not self.near_feasible(trial):
                returned = self.returned(trial)
                if returned is not None and (returned.merit < trial.merit or self.acceptable(returned)):
                    trial = returned
            if self.acceptable(trial):
                trial = trial if shortened else self.extrapolated(trial, stretch)
                return self.refined(trial) if refine else trial
            alpha, shortened = self.shorter(trial.alpha), True
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
        before = np.maximum(self.base.constraints, 0.0)
        allowed = np.maximum(self.thickness, (1.0 - 0.5 * self.direction.beta * min(trial.alpha, 1.0)) * before)
        return bool((trial.evaluation.constraints <= allowed).all())

    def acceptable(self, trial: Trial) -> bool:
        """Whether phi fell enough; from a feasible design, only a step to a feasible one."""
        if self.feasible and not self.near_feasible(trial):
            return False
        noise = NOISE * max(1.0, abs(self.merit0)) if self.worst(trial.evaluation) < 0.5 * self.worst(self.base) else 0.0
        return trial.merit <= self.merit0 + SUFFICIENT * min(trial.alpha, 1.0) * self.slope + noise

    def worst(self, evaluation: Evaluation) -> float:
        return float(np.maximum(evaluation.constraints, 0.0).max(initial=0.0))

    def returned(self, trial: Trial) -> Trial | None:
        """Return the trial moved back to the constraints that it crossed (smallest step in the metric B, gradients at hand)."""
        known = trial.evaluation.constraint_gradients
        gradients = self.base.constraint_gradients if known is None else known
        assert gradients is not None
        c = trial.evaluation.constraints
        rows = np.flatnonzero((c > 0.0) | (self.direction.multipliers > 0.0))
        bounded_above, bounded_below = np.isfinite(self.search.upper), np.isfinite(self.search.lower)
        identity = np.eye(self.y.size)
        A = np.vstack([gradients[rows], identity[bounded_above], -identity[bounded_below]])
        room = ((self.search.upper - trial.y)[bounded_above], (trial.y - self.search.lower)[bounded_below])
        solution = solve_quadratic(self.B, np.zeros(self.y.size), A, np.concatenate([-c[rows], *room]))
        if solution is None or np.abs(solution.s).max() > np.abs(trial.y - self.y).max():
            return None
        return self.attempt(trial.y + solution.s, trial.alpha)

    def shorter(self, alpha: float) -> float:
        """Return the alpha below the one just tried at which the polynomials see the lowest phi."""
        grid = np.linspace(0.05 * alpha, 0.7 * alpha, 66)
        return float(grid[np.argmin(self.modeled(grid))])

    def extrapolated(self, trial: Trial, stretch: float) -> Trial:
        """Go on along the direction while the polynomials promise much at a much longer step."""
        best = trial
        while self.used < self.most:
            grid = np.linspace(best.alpha, LONGEST_STRETCH * best.alpha, 81)
            promised = self.modeled(grid)
            choice = int(np.argmin(promised))
            worthwhile = best.merit - promised[choice] > 0.3 * (self.merit0 - best.merit)
            if grid[choice] < stretch * best.alpha or not worthwhile:
                return best
            longer = self.attempt(self.y + grid[choice] * self.direction.s, float(grid[choice]))
            if longer is None or longer.merit >= best.merit or not self.near_feasible(longer):
                return best
            best = longer
        return best

    def refined(self, trial: Trial) -> Trial:
        """Try the minimum of the polynomials between the start and the longest step once, if it promises a fair share more."""
        if self.used >= self.most:
            return trial
        grid = np.linspace(0.05, 1.0, 96) * max(t.alpha for t in self.trials)
        promised = self.modeled(grid)
        choice = int(np.argmin(promised))
        if trial.merit - promised[choice] <= 0.1 * (self.merit0 - trial.merit):
            return trial
        other = self.attempt(self.y + grid[choice] * self.direction.s, float(grid[choice]))
        return trial if other is None or other.merit >= trial.merit or not self.acceptable(other) else other

    def modeled(self, grid: np.ndarray) -> np.ndarray:
        """Return phi on the grid, of polynomials through the start (value, slope) and the last two trials (values)."""
        points = sorted(self.trials, key=lambda t: t.merit)[:2] if len(self.trials) > 2 else self.trials
        alphas = np.array([t.alpha for t in points])
        f = _polynomial(alphas, np.array([[t.evaluation.objective] for t in points]), np.array([self.base.objective]), self.df0, grid)
        values = f[:, 0]
        if self.base.constraints.size:
            known = np.array([t.evaluation.constraints for t in points])
            c = _polynomial(alphas, known, self.base.constraints, self.dc0, grid)
            values = values + np.maximum(c, 0.0) @ self.weights
        return values


def _polynomial(alphas: np.ndarray, values: np.ndarray, start: np.ndarray, slope, grid: np.ndarray) -> np.ndarray:
    """Interpolate `values` [k, m] at `alphas` [k] with value and slope [m] at zero; return [grid, m]. Degree k + 1."""
    distinct = np.unique(alphas, return_index=True)[1]
    alphas, values = alphas[distinct], values[distinct]
    powers = alphas[:, None] ** np.arange(2, 2 + alphas.size)
    higher = np.linalg.solve(powers, values - start - np.outer(alphas, np.broadcast_to(slope, start.shape)))
    return start + np.outer(grid, np.broadcast_to(slope, start.shape)) + grid[:, None] ** np.arange(2, 2 + alphas.size) @ higher
