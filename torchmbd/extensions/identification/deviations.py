"""Deviations of channels that are not given: estimated from the residuals by restricted maximum likelihood.

    nu_c = n_c - tr H_cc              degrees of freedom of a channel: its numbers less the unknowns that it determines
    sigma_c^2 = |r_c|^2 / nu_c        repeated with the unknowns of the least squares that the sigmas weigh
    L = sum_c n_c ln sigma_c + 1/2 sum |r|^2 / sigma^2 + 1/2 ln det J'J       the restricted likelihood is exp(-L)

H = J (J'J)^+ J', r and J in deviations. A channel whose numbers determine as many unknowns has no degrees of freedom: nothing
is known of its noise, and its deviation stays. Several sets of sigmas can repeat themselves: a few numbers that agree with
each other can outvote many. So the repetition also begins with the residuals that the fit has without one channel, for each;
the set with the smallest L is taken.

Residuals are linear in the unknowns here; the fit is repeated with the result.
Sources: Patterson and Thompson, Biometrika 58 (1971) 545-554; Förstner, Ein Verfahren zur Schätzung von Varianz- und
Kovarianzkomponenten (1979). Checked in tests/extensions/identification/test_deviations.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchmbd.extensions.identification.unseen import ROUNDING

NO_FREEDOM = 1e-6  # of the numbers of a channel: freedoms that are rounding
_LEAST = 1e-6  # of the deviation before: less asks too much of the sums of a group
_SETTLED = 1e-4  # change of the logarithms of all deviations
_MOST = 500  # repetitions
_BETTER = 1.0  # of L: less is not worth another solution


@dataclass(frozen=True)
class Group:
    """Residuals of a channel, or of all that is known, as sums over their rows.

    count   of the rows;  square: |r|^2;  slope: J'r [n];  curvature: J'J [n, n]
    estimated   whether the deviation is
    """

    count: int
    square: float
    slope: np.ndarray
    curvature: np.ndarray
    estimated: bool

    @classmethod
    def of(cls, values: np.ndarray, jacobian: np.ndarray, estimated: bool) -> Group:
        """Residuals [rows] and their derivatives with respect to the unknowns in units of their sizes [rows, n]."""
        return cls(len(values), float(values @ values), jacobian.T @ values, jacobian.T @ jacobian, estimated)


@dataclass(frozen=True)
class _State:
    """Deviations [groups], beside those of the residuals; what the least squares with them has."""

    sigmas: np.ndarray
    squares: np.ndarray
    freedoms: np.ndarray
    logdet: float

    def likelihood(self, groups: Sequence[Group]) -> float:
        """L of the module header."""
        counts = np.array([x.count for x in groups])
        return float(counts @ np.log(self.sigmas) + 0.5 * (self.squares / self.sigmas**2).sum() + 0.5 * self.logdet)


def leverages(jacobian: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Diagonal of H [rows]: how much of each number the unknowns follow."""
    U, S, _ = np.linalg.svd(jacobian * size, full_matrices=False)
    return (U[:, ROUNDING * S.max(initial=0.0) < S] ** 2).sum(1)


def estimated_deviations(groups: Sequence[Group]) -> np.ndarray:
    """Factors [groups] by which the deviations of the residuals change; 1 where they are known, or nothing is known."""
    first = _state(groups, np.ones(len(groups)))
    candidates, channels = [first.sigmas], _free(groups, first)
    if channels.sum() > 1:
        candidates += [_without(groups, channels, k) for k in np.flatnonzero(channels).tolist()]
    states = [_repeated(groups, sigmas) for sigmas in candidates]
    likelihoods = [state.likelihood(groups) for state in states]
    best = int(np.argmin(likelihoods))
    return states[best if likelihoods[best] < likelihoods[0] - _BETTER else 0].sigmas


def _repeated(groups: Sequence[Group], sigmas: np.ndarray) -> _State:
    """Repeat until the deviations stay."""
    state = _state(groups, sigmas)
    for _ in range(_MOST):
        new = _next(groups, state)
        change = np.abs(np.log(new / state.sigmas)).max()
        state = _state(groups, new)
        if change < _SETTLED:
            break
    return state


def _next(groups: Sequence[Group], state: _State) -> np.ndarray:
    result, free = state.sigmas.copy(), _free(groups, state)
    result[free] = np.maximum(np.sqrt(state.squares[free] / state.freedoms[free]), _LEAST)
    return result


def _free(groups: Sequence[Group], state: _State) -> np.ndarray:
    """Which groups have deviations that can be estimated."""
    counts = np.array([x.count for x in groups])
    return np.array([x.estimated for x in groups]) & (state.freedoms > NO_FREEDOM * counts)


def _without(groups: Sequence[Group], channels: np.ndarray, index: int) -> np.ndarray:
    """Deviations that residuals of channels have where the unknowns are those without one of them."""
    sigmas = np.ones(len(groups))
    sigmas[index] = 1.0 / _LEAST
    squares = _state(groups, sigmas).squares
    rms = np.sqrt(squares / [max(x.count, 1) for x in groups])
    return np.where(channels, np.maximum(rms, _LEAST), 1.0)


def _state(groups: Sequence[Group], sigmas: np.ndarray) -> _State:
    """The least squares that deviations weigh."""
    weights = 1.0 / sigmas**2
    curvature = sum(w * x.curvature for w, x in zip(weights, groups, strict=True))
    slope = sum(w * x.slope for w, x in zip(weights, groups, strict=True))
    values, vectors = np.linalg.eigh(curvature)
    seen = values > ROUNDING**2 * values.max(initial=0.0)
    vectors, values = vectors[:, seen], values[seen]
    inverse = (vectors / values) @ vectors.T
    step = -inverse @ slope
    squares = np.array([x.square + 2.0 * step @ x.slope + step @ x.curvature @ step for x in groups])
    traces = np.array([w * float((inverse * x.curvature).sum()) for w, x in zip(weights, groups, strict=True)])
    counts = np.array([x.count for x in groups])
    return _State(sigmas, np.maximum(squares, 0.0), counts - traces, float(np.log(values).sum()))
