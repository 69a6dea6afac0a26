"""Robust losses of residuals: rho(z) of the squares z = (r / scale)^2, with two derivatives, as scipy.optimize.least_squares
takes them.

    cost = 1/2 sum_k scale^2 rho(z_k)

Priors are not data: theirs is always the plain square. So one loss is applied to the measured rows alone, which the names of
SciPy's own losses cannot say; these are the same functions.
Source: Triggs et al., Bundle adjustment - a modern synthesis (2000); documentation of scipy.optimize.least_squares.
Checked in tests/extensions/identification/test_losses.py.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Loss = Callable[[np.ndarray], np.ndarray]


def linear(z: np.ndarray) -> np.ndarray:
    """The plain square."""
    return np.stack([z, np.ones_like(z), np.zeros_like(z)])


def soft_l1(z: np.ndarray) -> np.ndarray:
    """2 ((1 + z)^1/2 - 1)"""
    t = 1.0 + z
    return np.stack([2.0 * (np.sqrt(t) - 1.0), t**-0.5, -0.5 * t**-1.5])


def huber(z: np.ndarray) -> np.ndarray:
    """z up to 1, then 2 z^1/2 - 1"""
    t = np.maximum(z, 1.0)
    inner = z <= 1.0
    return np.stack([np.where(inner, z, 2.0 * np.sqrt(t) - 1.0), t**-0.5, np.where(inner, 0.0, -0.5 * t**-1.5)])


def cauchy(z: np.ndarray) -> np.ndarray:
    """ln(1 + z)"""
    t = 1.0 + z
    return np.stack([np.log1p(z), 1.0 / t, -1.0 / t**2])


def arctan(z: np.ndarray) -> np.ndarray:
    """arctan(z)"""
    t = 1.0 + z**2
    return np.stack([np.arctan(z), 1.0 / t, -2.0 * z / t**2])


LOSSES: dict[str, Loss] = {
    "linear": linear,
    "soft_l1": soft_l1,
    "huber": huber,
    "cauchy": cauchy,
    "arctan": arctan,
}


def of_rows(loss: Loss, data: int) -> Loss:
    """The loss for the first `data` rows, the plain square for those of priors after them."""

    def rho(z: np.ndarray) -> np.ndarray:
        return np.concatenate([loss(z[:data]), linear(z[data:])], 1)

    return rho
