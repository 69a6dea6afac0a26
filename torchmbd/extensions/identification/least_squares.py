"""One start of a fit: scipy.optimize.least_squares with our residuals and Jacobians.

    minimize 1/2 sum_k rho(r_k(b)^2)   subject to   lower <= b <= upper            unknowns in units of their scales

SciPy's "trf" rejects a trial step whose residuals are not numbers, and tries a quarter of it: so a design that cannot be
simulated ends no fit, and nothing is made up for it. Every design that was evaluated is counted; the best is never lost.

SciPy's own tests of convergence depend on units, and on the number of data. A search ends where the step that remains to the
minimum is a small part of the unknowns' deviations (gauss_newton.py).
Source: Branch, Coleman, Li, SIAM J. Sci. Comput. 21 (1999) 1-23 (method "trf" of SciPy).
Checked in tests/extensions/identification/test_least_squares.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchmbd.extensions.identification.fit_problem import Residuals
from torchmbd.extensions.identification.gauss_newton import RemainingStep, remaining_step
from torchmbd.extensions.identification.losses import Loss, of_rows
from torchmbd.extensions.identification.scales import scale_of_data
from torchmbd.optimization.search import Interrupted, OutOfTime, is_over

Evaluate = Callable[[np.ndarray, bool], Sequence[Any]]  # designs [k, n] in one batch
TOLERANCE = 1e-4  # part of their deviations by which unknowns may be off; Bates and Watts: 1e-3
NEAR = 0.1  # the same, where simulations do not say more
_EXACT = 1e-8  # of the unknowns' sizes: a step that is next to rounding, of data that the model has exactly
_NEARLY_EXACT = 1e-6  # the same, where simulations do not say more
_SMALLEST = 1e-9  # step of SciPy's search, of the unknowns in their units


@dataclass(frozen=True)
class FitSettings:
    """How a start is searched.

    lower, upper          bounds of the unknowns [n]
    scale                 their units [n]; nan: by the data, at the start (scales.py)
    data                  rows of the residuals that are not priors
    loss, f_scale         of these rows (losses.py)
    tolerance             part of the unknowns' deviations that a step to the minimum may be
    max_evaluations       designs at most
    deadline              by time.monotonic() [s], after which no design is simulated
    """

    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray
    data: int
    loss: Loss
    f_scale: float
    tolerance: float
    max_evaluations: int
    deadline: float = math.inf


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
    status         "converged", "stalled" beside designs that fail, "max_evaluations", "max_time", "failed" or "interrupted"
    message        a sentence why
    evaluations    simulated designs, each with its Jacobian;  failures: those of them that failed
    scale          units of the unknowns [n]; nan where they change no residual
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
    scale: np.ndarray
    history: list[FitStep] = field(default_factory=list)


class _OutOfEvaluations(Exception):
    """Ends SciPy's search at the limit of evaluations."""


class _AtMinimum(Exception):
    """Ends SciPy's search where no step remains."""


class _NewUnits(Exception):
    """Ends SciPy's search where the data say the unit of an unknown that changed nothing before."""


class _Start:
    """The function and the Jacobian that SciPy calls, in scaled unknowns y = b / scale."""

    def __init__(
        self, evaluate: Evaluate, settings: FitSettings, index: int, report: Callable[[FitStep], None] | None
    ) -> None:
        self.evaluate, self.settings, self.index, self.report = evaluate, settings, index, report
        self.scale = settings.scale
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
        return self.best[1] / self.units

    @property
    def units(self) -> np.ndarray:
        """Units that the search takes; an unknown without one changes nothing, and moves only if it is given one."""
        return np.where(np.isnan(self.scale), 1.0, self.scale)

    def take_units(self, x: np.ndarray, residuals: Residuals) -> bool:
        """Take units from the data where the settings leave them open; return whether there are new ones."""
        s, before = self.settings, int(np.isnan(self.scale).sum())
        if before and residuals.jacobian is not None:
            self.scale = scale_of_data(self.scale, x, s.lower, s.upper, residuals.values, residuals.jacobian)
        return int(np.isnan(self.scale).sum()) < before

    def remaining(self, x: np.ndarray, residuals: Residuals) -> RemainingStep:
        assert residuals.jacobian is not None
        s = self.settings
        return remaining_step(
            residuals.values, residuals.jacobian, x, s.lower, s.upper, self.units, s.loss, s.f_scale, s.data
        )

    def physical(self, y: np.ndarray) -> np.ndarray:
        return np.clip(y * self.units, self.settings.lower, self.settings.upper)

    def residuals_at(self, x: np.ndarray) -> Residuals:
        if self.last is not None and np.array_equal(self.last[0], x):
            return self.last[1]
        if self.best is not None and np.array_equal(self.best[1], x):
            return self.best[2]
        if self.evaluations >= self.settings.max_evaluations:
            raise _OutOfEvaluations
        if is_over(self.settings.deadline):
            raise OutOfTime
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
        x = self.physical(y)
        residuals = self.residuals_at(x)
        assert residuals.jacobian is not None
        step = self.remaining(x, residuals)
        if step.deviations <= self.settings.tolerance or step.sizes <= _EXACT:
            raise _AtMinimum
        if self.take_units(x, residuals):
            raise _NewUnits
        return residuals.jacobian * self.units


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
    begin: Callable[[Residuals], None] | None = None,
) -> Fit:
    """Search from one start [n]; a start that fails, and one that is interrupted, are results with a status.

    report   called with every design that lowers the cost;  begin: called with the residuals of the start
    """
    from scipy.optimize import least_squares

    start = _Start(evaluate, settings, index, report)
    x = np.clip(x, settings.lower, settings.upper)
    try:
        first = start.residuals_at(x)
        if not first.ok:
            message = f"the start: {first.status}"
            return Fit(index, x, np.nan, first, "failed", message, 1, 1, settings.scale)
        if begin is not None:
            begin(first)
        start.take_units(x, first)
        free = settings.lower < settings.upper
        status, message = _search(start, least_squares, x, free)
    except _OutOfEvaluations:
        status, message = "max_evaluations", f"the limit of {settings.max_evaluations} evaluations was reached"
        if start.failures:
            message += f"; {start.failures} designs failed, the last: {start.reason}"
    except OutOfTime:
        status, message = "max_time", "the limit of time was reached"
    except (Interrupted, KeyboardInterrupt):
        status, message = "interrupted", "stopped by the user"
    if start.best is None:
        nothing, count = Residuals(np.zeros(0), None, status), start.evaluations
        return Fit(index, x, np.nan, nothing, status, message, count, start.failures, settings.scale)
    cost, best, residuals = start.best
    counts = start.evaluations, start.failures
    return Fit(index, best, cost, residuals, status, message, *counts, start.scale, start.history)


def _search(start: _Start, least_squares: Callable[..., Any], x: np.ndarray, free: np.ndarray) -> tuple[str, str]:
    """SciPy's search over the unknowns whose bounds are not equal: status and message."""
    settings, y = start.settings, x / start.units
    if not free.any():
        return "converged", "all bounds are equal"

    def whole(part: np.ndarray) -> np.ndarray:
        z = y.copy()
        z[free] = part
        return z

    while True:
        failures, cost, units = start.failures, start.best_cost, start.units[free]
        try:
            ending = least_squares(
                lambda part: start.function(whole(part)),
                y[free],
                jac=lambda part: start.jacobian(whole(part))[:, free],
                bounds=(settings.lower[free] / units, settings.upper[free] / units),
                method="trf",
                loss=of_rows(settings.loss, settings.data),
                f_scale=settings.f_scale,
                ftol=None,
                xtol=_SMALLEST,
                gtol=None,
                max_nfev=settings.max_evaluations,
            )
        except _AtMinimum:
            return "converged", "no step remains to the minimum, to the tolerance"
        except _NewUnits:
            y = start.best_scaled
            continue
        if ending.status <= 0:
            return "max_evaluations", f"the limit of {settings.max_evaluations} evaluations was reached"
        # The steps became small. Those that were cut at designs that fail say nothing of a minimum.
        assert start.best is not None
        remaining = start.remaining(*start.best[1:])
        if start.failures == failures and (remaining.deviations <= NEAR or remaining.sizes <= _NEARLY_EXACT):
            return "converged", "no step remains to the minimum that the simulations are accurate enough to show"
        if not start.best_cost < (1.0 - settings.tolerance) * cost:
            if not start.failures:
                text = f"no smaller sum of squares, and {remaining.deviations:.2g} deviations of the unknowns to its minimum"
                return "stalled", text
            message = f"no smaller sum of squares beside designs that cannot be simulated, the last: {start.reason}"
            return "stalled", message
        y = start.best_scaled
