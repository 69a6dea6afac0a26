"""A problem of closed formulas: counts its evaluations, differentiates by complex steps (exact to rounding)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from torchmbd.optimization import Evaluation

Function = Callable[[np.ndarray], complex]
Constraints = Callable[[np.ndarray], Sequence[complex]]


def none(x: np.ndarray) -> list[complex]:
    return []


class Analytic:
    """min f(x), c(x) <= 0 in bounds; `fails(x)` names the part of the domain where a simulation would break down."""

    def __init__(
        self,
        name: str,
        start: Sequence[float],
        f: Function,
        c: Constraints = none,
        *,
        lower: Sequence[float] | float = -np.inf,
        upper: Sequence[float] | float = np.inf,
        optimum: float = float("nan"),
        local: Sequence[float] = (),
        fails: Callable[[np.ndarray], bool] = lambda x: False,
    ) -> None:
        self.name, self.f, self.c = name, f, c
        size = len(start)
        self.names = [f"x{i + 1}" for i in range(size)]
        self.lower = np.broadcast_to(np.asarray(lower, dtype=float), (size,)).copy()
        self.upper = np.broadcast_to(np.asarray(upper, dtype=float), (size,)).copy()
        self.start = np.clip(np.asarray(start, dtype=float), self.lower, self.upper)
        self.optimum, self.local = optimum, tuple(local)
        self.fails = fails
        self.reset()

    def reset(self) -> None:
        self.batches: list[tuple[int, bool]] = []  # (lanes, gradients) of every call
        self.points: set[bytes] = set()
        self.gradient_points: set[bytes] = set()

    @property
    def functions(self) -> int:
        """Distinct designs evaluated."""
        return len(self.points)

    @property
    def gradients(self) -> int:
        """Distinct designs evaluated with gradients."""
        return len(self.gradient_points)

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        assert X.ndim == 2
        assert np.all((self.lower <= X) & (self.upper >= X))
        self.batches.append((len(X), gradients))
        return [self._one(x, gradients) for x in X]

    def _one(self, x: np.ndarray, gradients: bool) -> Evaluation:
        self.points.add(x.tobytes())
        if gradients:
            self.gradient_points.add(x.tobytes())
        if self.fails(x):
            return Evaluation.failure("the simulation broke down")
        with np.errstate(all="ignore"):
            f, c = self._values(x)
            if not gradients:
                return Evaluation(f, c)
            step = 1e-30
            df, dc = np.empty(x.size), np.empty((c.size, x.size))
            for i in range(x.size):
                z = x.astype(complex)
                z[i] += 1j * step
                df[i] = np.imag(self.f(z)) / step
                dc[:, i] = np.imag(np.asarray(self.c(z), dtype=complex)) / step
        return Evaluation(f, c, df, dc)

    def _values(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        z = x.astype(complex)
        return float(np.real(self.f(z))), np.real(np.asarray(self.c(z), dtype=complex)).reshape(-1)
