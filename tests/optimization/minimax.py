"""Minimax problems as the paper treats them: min beta subject to f_i(x) - beta <= 0 (eqs. 19-20), beta the last variable.

Source: Luksan and Vlcek, Test problems for nonsmooth unconstrained and linearly constrained optimization, report 798, Academy
of Sciences of the Czech Republic (2000): starts and optima are theirs. A constant is added so that no objective is negative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy import cos, exp, sin

from tests.optimization.analytic import Analytic

SHIFT = 50.0


def minimax(name: str, start: Sequence[float], functions: Callable, optimum: float) -> Analytic:
    """Build the problem; beta starts at the largest function."""
    beta = max(np.real(functions(np.array(start, dtype=complex))))
    return Analytic(
        name,
        [*start, beta],
        lambda x: x[-1] + SHIFT,
        lambda x: [f - x[-1] for f in functions(x[:-1])],
        optimum=optimum + SHIFT,
    )


def rosen_suzuki(x):
    f = (x**2).sum() + x[2] ** 2 - 5 * x[0] - 5 * x[1] - 21 * x[2] + 7 * x[3]
    a = (x**2).sum() + x[0] - x[1] + x[2] - x[3] - 8
    b = x[0] ** 2 + 2 * x[1] ** 2 + x[2] ** 2 + 2 * x[3] ** 2 - x[0] - x[3] - 10
    c = x[0] ** 2 + x[1] ** 2 + x[2] ** 2 + 2 * x[0] - x[1] - x[3] - 5
    return [f, f + 10 * a, f + 10 * b, f + 10 * c]


def problems() -> list[Analytic]:
    def cb(x):
        return (2 - x[0]) ** 2 + (2 - x[1]) ** 2, 2 * exp(x[1] - x[0])

    def ql(x):
        square = x[0] ** 2 + x[1] ** 2
        return [square, square + 10 * (4 - 4 * x[0] - x[1]), square + 10 * (6 - x[0] - 2 * x[1])]

    return [
        minimax("CB2", [1, -0.1], lambda x: [x[0] ** 2 + x[1] ** 4, *cb(x)], 1.9522245),
        minimax("CB3", [2, 2], lambda x: [x[0] ** 4 + x[1] ** 2, *cb(x)], 2),
        minimax("DEM", [1, 1], lambda x: [5 * x[0] + x[1], x[1] - 5 * x[0], x[0] ** 2 + x[1] ** 2 + 4 * x[1]], -3),
        minimax("QL", [-1, 5], ql, 7.2),
        minimax("Rosen-Suzuki", [0, 0, 0, 0], rosen_suzuki, -44),
        minimax("LQ", [-0.5, -0.5], lambda x: [-x[0] - x[1], x[0] ** 2 + x[1] ** 2 - 1 - x[0] - x[1]], -np.sqrt(2)),
        minimax("Mifflin1", [0.8, 0.6], lambda x: [-x[0], 20 * (x[0] ** 2 + x[1] ** 2 - 1) - x[0]], -1),
        minimax("Madsen", [3, 1], lambda x: [x[0] ** 2 + x[1] ** 2 + x[0] * x[1], sin(x[0]), cos(x[1])], 0.61643244),
    ]
