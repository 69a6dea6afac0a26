"""Gradients by finite differences, for comparison with the exact ones only (eq. 29).

    central    df/db_k = (f(b + h_k/2 e_k) - f(b - h_k/2 e_k)) / h_k        error of order h^2, 2 n more simulations
    forward    df/db_k = (f(b + h_k e_k) - f(b)) / h_k                      error of order h, n more simulations

`Differences(problem)` wraps a problem: its evaluations have gradients by differences, so that optimizers, studies and figures
accept either. A large step has a large truncation error; a small step divides errors of rounding and of the integrator by h.
The best step depends on the design and is not known beforehand (section 5.1).
The shifted designs are simulated in one batch with the designs. Near an upper bound "forward" steps backward.
Checked in tests/design/test_differences.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from torchmbd.errors import InputError, unknown
from torchmbd.optimization import Evaluation
from torchmbd.optimization.optimizer import as_numbers, require_few, require_problem

SCHEMES = ("central", "forward")


def differences(
    function: Callable[[np.ndarray], np.ndarray],
    X: np.ndarray,
    step: float | Sequence[float] | np.ndarray,
    scheme: str = "central",
    upper: np.ndarray | float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Values [lanes, ...] and slopes [lanes, ..., n] of a function of a batch of designs [lanes, n], called once.

    step     Delta b in the units of b: one for all variables, one for each [n], or one for each of every design [lanes, n]
    scheme   "central" or "forward"
    Raises InputError for steps that are not positive, or so small that a design does not change.
    """
    if scheme not in SCHEMES:
        raise unknown("scheme", scheme, SCHEMES)
    X = np.asarray(X, dtype=float)
    lanes, n = X.shape
    h = np.broadcast_to(_steps(step, n, lanes), X.shape)
    sides = [h / 2, -h / 2] if scheme == "central" else [np.where(X + h > upper, -h, h)]
    # designs in which one variable is shifted [lanes, n, n]
    ends = [X[:, None, :] + side[:, :, None] * np.eye(n) for side in sides]
    values = function(np.concatenate([X, *(end.reshape(-1, n) for end in ends)]))
    middle, tails = values[:lanes], values[lanes:].reshape(len(ends), lanes, n, *values.shape[1:])
    start, origin = (tails[1], ends[1]) if scheme == "central" else (middle[:, None], X[:, None, :])
    actual = np.diagonal(ends[0] - origin, axis1=1, axis2=2)  # steps after rounding
    if not actual.all():
        raise InputError("step", step, "larger", shown=repr(step), state="does not change a design")
    slopes = (tails[0] - start) / actual.reshape(lanes, n, *[1] * (values.ndim - 1))
    return middle, np.moveaxis(slopes, 1, -1)


def _steps(step: Any, n: int, lanes: int | None = None) -> np.ndarray:
    h = as_numbers("step", step)
    if h.shape not in ((), (n,), (lanes, n)):
        raise InputError("step", h, f"a number, or {n} numbers", state=f"has shape {h.shape}")
    if not ((h > 0) & np.isfinite(h)).all():
        raise InputError("step", step, "positive numbers")
    return h


class Differences:
    """A problem whose gradients are finite differences; all other attributes are those of the wrapped problem.

    problem   the wrapped problem
    step      Delta b of eq. (29) in the units of the design [rad for angles], one for all or one for each variable
    scheme    "central" or "forward"

    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, mbd.Integral(mbd.StrainEnergy("arm")), steps=20)
    >>> [exact] = problem.evaluate(problem.start[None], True)
    >>> [approximate] = mbd.Differences(problem).evaluate(problem.start[None], True)
    >>> bool(np.allclose(exact.objective_gradient, approximate.objective_gradient, rtol=1e-4))
    True
    """

    def __init__(self, problem: Any, step: float | Sequence[float] = 1e-4, scheme: str = "central"):
        if scheme not in SCHEMES:
            raise unknown("scheme", scheme, SCHEMES)
        require_problem(problem)
        require_few("problem", problem, "Differences", len(problem.names), "the gradients of the problem itself")
        self._problem, self.step, self.scheme = problem, _steps(step, len(problem.names)), scheme

    def __getattr__(self, name: str) -> Any:
        if name == "_problem":  # missing while an instance is unpickled
            raise AttributeError(name)
        return getattr(self._problem, name)

    def settings(self) -> list[Any]:
        """All settings that determine the evaluations, except the values of the design variables."""
        settings = getattr(type(self._problem), "settings", None)
        wrapped = [self._problem] if settings is None else self._problem.settings()
        turned = [self._problem.upper] if self.scheme == "forward" else []  # where steps go backward
        return [*wrapped, self.step, self.scheme, *turned]

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n]; with gradients, they and all shifted designs are one batch."""
        X = np.asarray(X, dtype=float)
        if not gradients:
            return self._problem.evaluate(X, False)
        evaluations: list[Evaluation] = []

        def numbers(designs: np.ndarray) -> np.ndarray:
            evaluations.extend(self._problem.evaluate(designs, False))
            return np.stack([[e.objective, *e.constraints] for e in evaluations])

        _, slopes = differences(numbers, X, self.step, self.scheme, self._problem.upper)
        lanes = len(X)
        shifted = np.arange(lanes, len(evaluations)).reshape(-1, *X.shape)  # indices of evaluations [ends, lanes, n]
        return [
            self._evaluation(evaluations[lane], [evaluations[i] for i in shifted[:, lane].flat], slopes[lane])
            for lane in range(lanes)
        ]

    @staticmethod
    def _evaluation(center: Evaluation, neighbors: Sequence[Evaluation], slopes: np.ndarray) -> Evaluation:
        failed = next((e.status for e in neighbors if not e.ok), None)
        if not center.ok or failed is not None:
            reason = center.status if not center.ok else f"failed: a neighbor of the design: {failed}"
            return Evaluation.failure(reason, len(center.constraints))
        return Evaluation(center.objective, center.constraints, slopes[0], slopes[1:])
