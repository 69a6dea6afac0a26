"""Every design on a grid of ply angles, simulated: what the discrete search and the multistart are compared with.

All angles that are multiples of the increment in (-90, 90], or in [-limit, limit]: N^layers designs. A rod mirrored at the
plane of motion has all its angles negated and moves as before, so one design of each such pair is simulated (the energies
of pairs agree to 1e-11).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

import torchmbd as mbd


@dataclass(frozen=True)
class Enumeration:
    """What one problem says of every design.

    X          [designs, layers], one design of each mirror pair [rad]
    value      [designs], inf where the simulation failed or a constraint is violated
    size       designs of the whole grid
    """

    X: np.ndarray
    value: np.ndarray
    size: int

    @property
    def best(self) -> np.ndarray:
        """The best design [layers], [rad]."""
        return self.X[np.argmin(self.value)]

    def rank(self, value: float) -> int:
        """How many of the designs simulated are better than `value`, by more than rounding."""
        return int((self.value < value * (1.0 - 1e-9)).sum())

    def minima(self, increment: float) -> np.ndarray:
        """Indices of the designs that no neighbor within one increment of every angle betters, the best first."""
        steps = np.rint(self.X / increment).astype(int)
        turn = round(np.pi / increment)
        table = np.full((turn,) * self.X.shape[1], np.inf)
        for sign in (1, -1):
            table[tuple((sign * steps % turn).T)] = self.value
        least = table.copy()
        for axis in range(table.ndim):
            least = np.minimum(least, np.minimum(np.roll(least, 1, axis), np.roll(least, -1, axis)))
        finite = np.flatnonzero((self.value <= least[tuple((steps % turn).T)]) & np.isfinite(self.value))
        return finite[np.argsort(self.value[finite], kind="stable")]


def grid(layers: int, increment: float, limit: float = 90.0) -> tuple[np.ndarray, int]:
    """One design of each mirror pair [designs, layers] and the number of all; `increment` a part of `limit` [deg]."""
    first = -limit + increment if limit == 90.0 else -limit  # -90 is 90
    values = np.arange(first, limit + increment / 2, increment)
    X = np.array(list(product(values, repeat=layers)))
    mirrored = np.where(X == 90.0, 90.0, -X)
    first = mirrored != X
    leading = np.where(first.any(axis=1), np.argmax(first, axis=1), 0)
    rows = np.arange(len(X))
    return np.radians(X[X[rows, leading] >= mirrored[rows, leading]]), len(X)


def enumerate_all(
    problems: Mapping[str, mbd.Problem], increment: float, limit: float = 90.0, lanes: int = 512
) -> dict[str, Enumeration]:
    """Simulate the grid once for problems that differ in their measures only; `increment` and `limit` in degrees."""
    first = next(iter(problems.values()))
    X, size = grid(len(first.space.start), increment, limit)
    values = {name: np.full(len(X), np.inf) for name in problems}
    for k in range(0, len(X), lanes):
        motion = first.simulate(X[k : k + lanes])
        simulated = np.array([status == "ok" for status in motion.status])
        for name, problem in problems.items():
            reference, ok = problem.reference, simulated
            objective, *others = (measure.value(motion).numpy() for measure in reference.measures)
            for c, limit, scale in zip(others, reference.limits, reference.scale, strict=True):
                ok = ok & ((c - limit) / scale <= 1e-6)
            values[name][k : k + lanes] = np.where(ok, objective, np.inf)
    return {name: Enumeration(X, value, size) for name, value in values.items()}
