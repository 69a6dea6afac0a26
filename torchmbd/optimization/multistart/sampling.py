"""Where to start: points spread over the bounds of a problem, drawn when the problem is known.

Source: Sobol sequence with Owen scrambling and Latin hypercube of scipy.stats.qmc, which takes half a second to import:
that is done when points are drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from torchmbd.errors import InputError, true_or_false
from torchmbd.optimization.optimizer import Box, as_numbers, require_count


@dataclass(frozen=True)
class Starts:
    """A rule for start designs: `points(problem)` returns them, [count, n] in physical units."""

    name: str
    count: int
    draw: Callable[[Box], np.ndarray]

    def points(self, problem: Box) -> np.ndarray:
        return self.draw(problem)


def sobol(count: int, seed: int, include_initial: bool = False) -> Starts:
    """Start designs of a scrambled Sobol sequence over the bounds of the problem [count, n].

    count            number of designs
    seed             of the scrambling; the same seed, the same points
    include_initial  the first of them is the problem's own start

    `points(problem)` raises InputError for bounds that are not finite. Source: Owen scrambling of scipy.stats.qmc.

    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, mbd.Mass(), bounds=mbd.deg([-90, 90]))
    >>> mbd.optimization.sobol(4, seed=7).points(problem).shape
    (4, 2)
    """
    return _drawn("sobol", _sobol, count, seed, include_initial)


def latin_hypercube(count: int, seed: int, include_initial: bool = False) -> Starts:
    """Start designs [count, n]; the values of each variable fill its range evenly.

    count, seed, include_initial   as in `sobol`
    Source: Latin hypercube of scipy.stats.qmc.

    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, mbd.Mass(), bounds=mbd.deg([-90, 90]))
    >>> points = mbd.optimization.latin_hypercube(4, seed=7).points(problem)
    >>> sorted(np.floor((points[:, 0] / np.pi + 0.5) * 4).astype(int).tolist())  # one in each quarter of the range
    [0, 1, 2, 3]
    """
    return _drawn("latin_hypercube", _latin, count, seed, include_initial)


def _drawn(name: str, sample: Callable[[int, int, int], np.ndarray], count: int, seed: int, include: bool) -> Starts:
    require_count("count", count, 1, 2**20)
    require_count("seed", seed, 0, 2**63)
    return Starts(
        name, count, partial(_spread, partial(sample, seed), count, true_or_false("include_initial", include))
    )


def starts_at(points: Sequence[Sequence[float] | np.ndarray]) -> Starts:
    """Return the listed starts, in their order."""
    designs = [as_numbers("points", point) for point in points]
    X = np.array(designs) if len({x.shape for x in designs}) == 1 else np.zeros(0)
    if X.ndim != 2 or not X.size:
        raise InputError("points", allowed="a list of at least one start design, each with one value for each variable")
    return Starts("given", len(X), partial(_listed, X))


def _listed(X: np.ndarray, problem: Box) -> np.ndarray:
    return X


def recipe(starts: Starts | Sequence[Any] | np.ndarray | None, initial: np.ndarray) -> Starts:
    """Return the starts that an argument of this name stands for; None: the initial design alone."""
    if starts is None or isinstance(starts, Starts):
        return starts_at([initial]) if starts is None else starts
    if isinstance(starts, str) or not isinstance(starts, Iterable):
        raise InputError("starts", starts, "mbd.optimization.sobol(...) or another sampler, a list of designs, or None")
    return starts_at(list(starts))


def _sobol(seed: int, size: int, number: int) -> np.ndarray:
    from scipy.stats import qmc

    # A whole power of two keeps the balance of the sequence; its beginning is used.
    exponent = max(int(np.ceil(np.log2(max(number, 1)))), 0)
    return qmc.Sobol(size, scramble=True, rng=seed).random_base2(exponent)[:number]


def _latin(seed: int, size: int, number: int) -> np.ndarray:
    from scipy.stats import qmc

    return qmc.LatinHypercube(size, rng=seed).random(number)


def _spread(unit: Callable[[int, int], np.ndarray], count: int, include_initial: bool, problem: Box) -> np.ndarray:
    """Points [count, n] of the unit cube [size, number], over the bounds of the problem.

    The extra variable of a min-max problem, which is not a design variable, begins as that of the start.
    """
    lower, upper = np.array(problem.lower, dtype=float), np.array(problem.upper, dtype=float)
    if getattr(problem, "has_extra_variable", False):
        lower[-1] = upper[-1] = problem.start[-1]
    for name, low, high in zip(problem.names, lower, upper, strict=True):
        if not (np.isfinite(low) and np.isfinite(high)):
            raise InputError(
                ("bounds", name),
                (low, high),
                noun=f"bounds of {name}",
                allowed="finite, because starts are spread over them",
                state=f"are [{low:g}, {high:g}]",
            )
    number = count - include_initial
    X = lower + (upper - lower) * unit(lower.size, number) if number else np.zeros((0, lower.size))
    return np.vstack([np.asarray(problem.start, dtype=float), X]) if include_initial else X
