"""The values that discrete variables may take, and what lies around a design on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.optimization.optimizer import Box

ON = 1e-6  # of the spacing: so near is on a value
MOST = 1_000_000  # values of one variable
Allowed = float | Sequence[float] | np.ndarray | None


class Grid:
    """`values[j]`: ascending allowed values of variable j inside its bounds, None where it is continuous.

    `allowed` has one entry per variable: an increment (its multiples are allowed), a list of values, or None; a single
    increment or None serves all. The extra variable of a min-max problem has None. A variable with a `period` whose values
    fill it has neighbors across its ends.
    `admits(x)` says whether a design on the values keeps the user's rules.
    """

    def __init__(
        self,
        problem: Box,
        allowed: Allowed | Sequence[Allowed],
        lower: np.ndarray,
        upper: np.ndarray,
        period: np.ndarray | None,
        admits: Callable[[np.ndarray], bool] = lambda x: True,
    ) -> None:
        self.admits = admits
        names = list(problem.names)
        entries = [allowed] * len(names) if allowed is None or _single(allowed) else _listed(allowed)
        if len(entries) != len(names):
            raise InputError(
                "allowed", allowed=f"must have {len(names)} ({', '.join(names)})", state=f"has {len(entries)} entries"
            )
        if getattr(problem, "has_extra_variable", False):
            if entries[-1] is not None and not _single(allowed):
                raise InputError(
                    ("allowed", names[-1]), entries[-1], "None, because this variable is the largest of the rows"
                )
            entries[-1] = None
        self.values = [_values(*row) for row in zip(names, entries, lower, upper, strict=True)]  # type: ignore[arg-type]
        turns = np.zeros(len(names)) if period is None else np.asarray(period, dtype=float)
        self.circle = [v is not None and _fills(v, turn) for v, turn in zip(self.values, turns, strict=True)]
        self.discrete = np.array([v is not None for v in self.values])
        if not self.discrete.any():
            raise InputError(
                "allowed",
                hint="optimize or multistart",
                allowed="must have an increment or values for at least one variable",
            )

    @property
    def size(self) -> int:
        """How many designs there are, continuous variables not counted."""
        return int(np.prod([float(len(v)) for v in self.values if v is not None]))

    def nearest(self, x: np.ndarray) -> np.ndarray:
        """Return x [n] rounded."""
        return np.array([a if v is None else v[np.argmin(np.abs(v - a))] for a, v in zip(x, self.values, strict=True)])

    def nearest_admitted(self, x: np.ndarray, steps: int, at_most: int) -> np.ndarray | None:
        """Return the rounded x [n], or the nearest design within `steps` increments of it that is admitted; or None."""
        rounded = self.nearest(x)
        if self.admits(rounded):
            return rounded
        X, _ = self.neighbors(rounded, steps, at_most)
        return X[np.argmin((self.increments(X, x) ** 2).sum(axis=1))] if len(X) else None

    def increments(self, X: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return how many increments each variable of designs X [k, n] is from x [n]; 0 for continuous ones [k, n].

        Differences in the units of the variables would let these units choose the nearest design.
        """
        result = np.zeros(X.shape)
        for j, values in enumerate(self.values):
            if values is not None:
                numbers = np.arange(len(values))
                moved = np.interp(X[:, j], values, numbers) - np.interp(x[j], values, numbers)
                turn = len(values) - 1
                result[:, j] = moved - turn * np.round(moved / turn) if self.circle[j] else moved
        return result

    def off(self, x: np.ndarray) -> np.ndarray:
        """Return how far each variable is from its values, as a share of the gap it lies in: 0 to 0.5 [n]."""
        distances = np.zeros(x.size)
        for j in np.flatnonzero(self.discrete):
            below, above = self.around(x, int(j))
            gap = above - below
            distances[j] = min(x[j] - below, above - x[j]) / gap if gap > 0.0 else 0.0
        return np.where(distances < ON, 0.0, distances)

    def within(self, j: int, low: float, high: float) -> np.ndarray:
        """Return the ascending values of variable j from low to high [k]; none of a continuous variable."""
        values = self.values[j]
        return np.empty(0) if values is None else values[(values >= low) & (values <= high)]

    def around(self, x: np.ndarray, j: int) -> tuple[float, float]:
        """Return the values next to variable j, below and above (the same where it is on one, or outside of all)."""
        values = self.values[j]
        assert values is not None
        k = int(np.searchsorted(values, x[j]))
        return float(values[max(k - 1, 0)] if k == len(values) or values[k] > x[j] else values[k]), float(
            values[min(k, len(values) - 1)]
        )

    def neighbors(self, x: np.ndarray, steps: int, at_most: int) -> tuple[np.ndarray, str]:
        """Return the admitted designs [k, n] within `steps` increments of x, on the grid, and in words which these are.

        Each variable may move so many increments; where these are more than `at_most` designs, all together may.
        """
        moves = [self._moves(x[j], j, steps) for j in range(x.size)]
        if np.prod([float(len(m)) for m in moves]) - 1 <= at_most:
            words = f"every variable up to {steps} increments away"
            combined = [[value for _, value in choice] for choice in product(*moves)]
        else:
            words = f"up to {steps} increments away in all"
            combined = [[value for _, value in choice] for choice in _within(moves, steps)]
        X = [y for y in np.array(combined) if (x != y).any() and self.admits(y)]
        return np.array(X).reshape(-1, x.size), words

    def _moves(self, value: float, j: int, steps: int) -> list[tuple[int, float]]:
        """Return increments and the value of variable j that they lead to, none twice."""
        values = self.values[j]
        if values is None:
            return [(0, value)]
        here, count = int(np.argmin(np.abs(values - value))), len(values)
        moves = {here: (0, float(value))}
        for step in sorted(range(-steps, steps + 1), key=abs):
            k = here + step
            if self.circle[j]:
                k %= count - 1  # the last value is the first
                if k == here % (count - 1):
                    continue
            if 0 <= k < count:
                moves.setdefault(k, (abs(step), float(values[k])))
        return list(moves.values())


def _listed(allowed: Any) -> list[Any]:
    if isinstance(allowed, (str, Mapping)) or not isinstance(allowed, Iterable):
        raise InputError("allowed", allowed, "an increment, values, or one of these for each variable")
    return list(allowed)


def _within(moves: list[list[tuple[int, float]]], steps: int) -> list[list[tuple[int, float]]]:
    """Return all choices of one move per variable that take `steps` increments at most."""
    if not moves:
        return [[]]
    return [[move, *rest] for move in moves[0] if move[0] <= steps for rest in _within(moves[1:], steps - move[0])]


def _values(name: str, entry: Allowed, low: float, high: float) -> np.ndarray | None:
    """Return the ascending values of one variable inside its bounds."""
    if entry is None:
        return None
    if _single(entry):
        increment = float(_numbers(name, entry))
        if not (increment > 0.0 and np.isfinite(high - low)):
            raise InputError(("allowed", name), entry, f"positive, within finite bounds, which are [{low:g}, {high:g}]")
        if (high - low) / increment > MOST:
            count, place = (high - low) / increment, f"in the bounds [{low:g}, {high:g}]"
            allowed = f"must give at most {MOST} values, instead of {count:.3g} ({8 * count:.3g} bytes) {place}"
            raise InputError(("allowed", name), entry, allowed)
        slack = ON * increment
        values = increment * np.arange(np.ceil((low - slack) / increment), np.floor((high + slack) / increment) + 1)
    else:
        values = np.unique(_numbers(name, entry))
        slack = 1e-12 * max(abs(low), abs(high), 1.0) if np.isfinite(high - low) else 0.0
        values = values[(values >= low - slack) & (values <= high + slack)]
    if not values.size or not np.isfinite(values).all():
        raise InputError(("allowed", name), entry, f"must have a value in the bounds [{low:g}, {high:g}]")
    return np.clip(values, low, high) + 0.0


def _numbers(name: str, entry: Any) -> np.ndarray:
    try:
        return np.asarray(entry, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            ("allowed", name), entry, "an increment, or a list of values", noun=f"allowed of {name}"
        ) from error


def _single(value: Any) -> bool:
    """True if this is one number, a tensor of one, such as mbd.deg(5), included."""
    return np.isscalar(value) or getattr(value, "ndim", None) == 0


def _fills(values: np.ndarray, period: float) -> bool:
    return bool(period > 0.0 and len(values) > 1 and np.isclose(values[-1] - values[0], period, rtol=1e-9))
