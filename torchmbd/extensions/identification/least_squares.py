"""One start of a fit: scipy.optimize.least_squares with our residuals and Jacobians.

    minimize 1/2 sum_k rho(r_k(b)^2)   subject to   lower <= b <= upper            unknowns in units of their scales

SciPy's "trf" rejects a trial step whose residuals are not numbers, and tries a quarter of it: so a design that cannot be
simulated ends no fit, and nothing is made up for it. Every design that was evaluated is counted; the best is never lost.
Source: Branch, Coleman, Li, SIAM J. Sci. Comput. 21 (1999) 1-23 (method "trf" of SciPy).
Checked in tests/extensions/identification/test_least_squares.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchmbd.extensions.identification.fit_problem import Residuals
from torchmbd.extensions.identification.losses import Loss, of_rows
from torchmbd.optimization.search import Interrupted

Evaluate = Callable[[np.ndarray, bool], Sequence[Any]]  # designs [k, n] in one batch
_MESSAGES = {
    1: "the gradient is zero to the tolerance",
    2: "the sum of squares changes by less than the tolerance",
    3: "the unknowns change by less than the tolerance",
    4: "sum of squares and unknowns change by less than the tolerance",
}


@dataclass(frozen=True)
class FitSettings:
    """How a start is searched.

    lower, upper, scale   bounds and units of the unknowns [n]
    data                  rows of the residuals that are no priors
    loss, f_scale         of these rows (losses.py)
    tolerance             relative, of cost, unknowns and gradient
    max_evaluations       designs at most
    """

    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray
    data: int
    loss: Loss
    f_scale: float
    tolerance: float
    max_evaluations: int


@dataclass(frozen=True)
class FitStep:
    """A design of a start that lowered the cost; iteration 0 is the start itself."""

    start: int
    iteration: int
    x: np.ndarray
    cost: float
    evaluations: int


@dataclass(eq=False)
class Fit:
    """How a start ended.

    start          its number;  x, cost, residuals: of the best design
    status         "converged", "stalled" beside designs that fail, "max_evaluations", "failed" or "interrupted"
    message        a sentence why
    evaluations    simulated designs, each with its Jacobian;  failures: those of them that failed
    history        designs that lowered the cost
    """

    start: int
    x: np.ndarray
    cost: float
    residuals: Residuals
    status: str
    message: str
    evaluations: int
    failures: int
    history: list[FitStep] = field(default_factory=list)


class _OutOfEvaluations(Exception):
    """Ends SciPy's search at the limit of evaluations."""


class _Start:
    """The function and the Jacobian that SciPy calls, in scaled unknowns y = b / scale."""

    def __init__(
        self, evaluate: Evaluate, settings: FitSettings, index: int, report: Callable[[FitStep], None] | None
    ) -> None:
        self.evaluate, self.settings, self.index, self.report = evaluate, settings, index, report
        self.evaluations = self.failures = 0
        self.last: tuple[np.ndarray, Residuals] | None = None
        self.best: tuple[float, np.ndarray, Residuals] | None = None
        self.history: list[FitStep] = []
        self.reason = ""

    @property
    def best_cost(self) -> float:
        return np.inf if self.best is None else self.best[0]

    @property
    def best_scaled(self) -> np.ndarray:
        assert self.best is not None
        return self.best[1] / self.settings.scale

    def physical(self, y: np.ndarray) -> np.ndarray:
        return np.clip(y * self.settings.scale, self.settings.lower, self.settings.upper)

    def residuals_at(self, x: np.ndarray) -> Residuals:
        if self.last is not None and np.array_equal(self.last[0], x):
            return self.last[1]
        if self.best is not None and np.array_equal(self.best[1], x):
            return self.best[2]
        if self.evaluations >= self.settings.max_evaluations:
            raise _OutOfEvaluations
        [residuals] = self.evaluate(x[None], True)
        self.evaluations += 1
        self.last = x, residuals
        if not residuals.ok:
            self.failures += 1
            self.reason = residuals.status
            return residuals
        cost = cost_of(residuals.values, self.settings)
        if self.best is None or cost < self.best[0]:
            self.best = cost, x, residuals
            step = FitStep(self.index, len(self.history), x, cost, self.evaluations)
            self.history.append(step)
            if self.report is not None:
                self.report(step)
        return residuals

    def function(self, y: np.ndarray) -> np.ndarray:
        return self.residuals_at(self.physical(y)).values

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        jacobian = self.residuals_at(self.physical(y)).jacobian
        assert jacobian is not None
        return jacobian * self.settings.scale


def cost_of(values: np.ndarray, settings: FitSettings) -> float:
    """Half the sum of the losses of residuals [rows]."""
    rho = of_rows(settings.loss, settings.data)((values / settings.f_scale) ** 2)[0]
    return 0.5 * settings.f_scale**2 * float(rho.sum())


def fit_start(
    evaluate: Evaluate,
    x: np.ndarray,
    settings: FitSettings,
    index: int = 0,
    report: Callable[[FitStep], None] | None = None,
) -> Fit:
    """Search from one start [n]; a start that fails, and one that is interrupted, are results with a status."""
    from scipy.optimize import least_squares

    start = _Start(evaluate, settings, index, report)
    x = np.clip(x, settings.lower, settings.upper)
    try:
        first = start.residuals_at(x)
        if not first.ok:
            return Fit(index, x, np.nan, first, "failed", f"the start: {first.status}", 1, 1)
        free = settings.lower < settings.upper
        status, message = _search(start, least_squares, x, free)
    except _OutOfEvaluations:
        status, message = "max_evaluations", f"the limit of {settings.max_evaluations} evaluations was reached"
        if start.failures:
            message += f"; {start.failures} designs failed, the last: {start.reason}"
    except (Interrupted, KeyboardInterrupt):
        status, message = "interrupted", "stopped by the user"
    if start.best is None:
        return Fit(
            index, x, np.nan, Residuals(np.zeros(0), None, status), status, message, start.evaluations, start.failures
        )
    cost, best, residuals = start.best
    return Fit(index, best, cost, residuals, status, message, start.evaluations, start.failures, start.history)


def _search(start: _Start, least_squares: Callable[..., Any], x: np.ndarray, free: np.ndarray) -> tuple[str, str]:
    """SciPy's search over the unknowns whose bounds are not equal: status and message."""
    settings, y = start.settings, x / start.settings.scale
    if not free.any():
        return "converged", "all bounds are equal"

    def whole(part: np.ndarray) -> np.ndarray:
        z = y.copy()
        z[free] = part
        return z

    tolerance = settings.tolerance
    while True:
        failures, cost = start.failures, start.best_cost
        ending = least_squares(
            lambda part: start.function(whole(part)),
            y[free],
            jac=lambda part: start.jacobian(whole(part))[:, free],
            bounds=(settings.lower[free] / settings.scale[free], settings.upper[free] / settings.scale[free]),
            method="trf",
            loss=of_rows(settings.loss, settings.data),
            f_scale=settings.f_scale,
            ftol=tolerance,
            xtol=tolerance,
            gtol=tolerance,
            max_nfev=settings.max_evaluations,
        )
        if ending.status not in _MESSAGES:
            return "max_evaluations", f"the limit of {settings.max_evaluations} evaluations was reached"
        if start.failures == failures:
            return "converged", _MESSAGES[ending.status]
        # Steps that were cut at designs that fail are small, which says nothing of a minimum: once more from there.
        if not start.best_cost < (1.0 - tolerance) * cost:
            message = f"no smaller sum of squares beside designs that cannot be simulated, the last: {start.reason}"
            return "stalled", message
        y = start.best_scaled
