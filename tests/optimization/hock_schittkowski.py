"""Problems with known optima.

Source: Hock and Schittkowski, Test Examples for Nonlinear Programming Codes, Lecture Notes in Economics and
Mathematical Systems 187 (1981): the numbers are theirs, every constraint is turned to c(x) <= 0, a start outside the
bounds is moved onto them. `local` lists other local minima (objective) where a local method may rightly end.
"""

from __future__ import annotations

import numpy as np
from numpy import exp, log, sin

from tests.optimization.analytic import Analytic
from tests.optimization.hock_schittkowski_large import four_and_five_variables, many_variables


def rosenbrock(x):
    return 100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2


def bounded() -> list[Analytic]:
    """Problems with bounds only."""

    def hs38(x):
        return (
            100 * (x[1] - x[0] ** 2) ** 2
            + (1 - x[0]) ** 2
            + 90 * (x[3] - x[2] ** 2) ** 2
            + (1 - x[2]) ** 2
            + 10.1 * ((x[1] - 1) ** 2 + (x[3] - 1) ** 2)
            + 19.8 * (x[1] - 1) * (x[3] - 1)
        )

    def hs110(x):
        return (log(x - 2) ** 2 + log(10 - x) ** 2).sum() - x.prod() ** 0.2

    return [
        Analytic("HS1", [-2, 1], rosenbrock, lower=[-np.inf, -1.5], optimum=0),
        Analytic("HS2", [-2, 1], rosenbrock, lower=[-np.inf, 1.5], optimum=0.0504261879, local=[4.941229318]),
        Analytic("HS3", [10, 1], lambda x: x[1] + 1e-5 * (x[1] - x[0]) ** 2, lower=[-np.inf, 0], optimum=0),
        Analytic("HS4", [1.125, 0.125], lambda x: (x[0] + 1) ** 3 / 3 + x[1], lower=[1, 0], optimum=8 / 3),
        Analytic(
            "HS5",
            [0, 0],
            lambda x: sin(x[0] + x[1]) + (x[0] - x[1]) ** 2 - 1.5 * x[0] + 2.5 * x[1] + 1,
            lower=[-1.5, -3],
            upper=[4, 3],
            optimum=-np.sqrt(3) / 2 - np.pi / 3,
        ),
        Analytic("HS38", [-3, -1, -3, -1], hs38, lower=-10, upper=10, optimum=0),
        Analytic("HS45", [2] * 5, lambda x: 2 - x.prod() / 120, lower=0, upper=[1, 2, 3, 4, 5], optimum=1),
        Analytic("HS110", [9] * 10, hs110, lower=2.001, upper=9.999, optimum=-45.77846971),
    ]


def two_variables() -> list[Analytic]:
    box = {"lower": [-0.5, -np.inf], "upper": [0.5, 1]}
    return [
        Analytic(
            "HS10",
            [-10, 10],
            lambda x: x[0] - x[1],
            lambda x: [3 * x[0] ** 2 - 2 * x[0] * x[1] + x[1] ** 2 - 1],
            optimum=-1,
        ),
        Analytic(
            "HS11",
            [4.9, 0.1],
            lambda x: (x[0] - 5) ** 2 + x[1] ** 2 - 25,
            lambda x: [x[0] ** 2 - x[1]],
            optimum=-8.498464223,
        ),
        Analytic(
            "HS12",
            [0, 0],
            lambda x: 0.5 * x[0] ** 2 + x[1] ** 2 - x[0] * x[1] - 7 * x[0] - 7 * x[1],
            lambda x: [4 * x[0] ** 2 + x[1] ** 2 - 25],
            optimum=-30,
        ),
        Analytic(
            "HS15",
            [-2, 1],
            rosenbrock,
            lambda x: [1 - x[0] * x[1], -x[0] - x[1] ** 2],
            upper=[0.5, np.inf],
            optimum=306.5,
            local=[360.3797672],
        ),
        Analytic(
            "HS16",
            [-2, 1],
            rosenbrock,
            lambda x: [-x[0] - x[1] ** 2, -(x[0] ** 2) - x[1]],
            **box,
            optimum=0.25,
            local=[23.14466, 3.98210],
        ),
        Analytic("HS17", [-2, 1], rosenbrock, lambda x: [x[0] - x[1] ** 2, x[1] - x[0] ** 2], **box, optimum=1),
        Analytic(
            "HS18",
            [2, 2],
            lambda x: 0.01 * x[0] ** 2 + x[1] ** 2,
            lambda x: [25 - x[0] * x[1], 25 - x[0] ** 2 - x[1] ** 2],
            lower=[2, 0],
            upper=50,
            optimum=5,
        ),
        Analytic(
            "HS19",
            [20.1, 5.84],
            lambda x: (x[0] - 10) ** 3 + (x[1] - 20) ** 3,
            lambda x: [100 - (x[0] - 5) ** 2 - (x[1] - 5) ** 2, (x[0] - 6) ** 2 + (x[1] - 5) ** 2 - 82.81],
            lower=[13, 0],
            upper=100,
            optimum=-6961.81381,
        ),
        Analytic(
            "HS20",
            [-2, 1],
            rosenbrock,
            lambda x: [-x[0] - x[1] ** 2, -(x[0] ** 2) - x[1], 1 - x[0] ** 2 - x[1] ** 2],
            lower=[-0.5, -np.inf],
            upper=[0.5, np.inf],
            optimum=81.5 - 25 * np.sqrt(3),
            local=[40.1987298],
        ),
        Analytic(
            "HS21",
            [-1, -1],
            lambda x: 0.01 * x[0] ** 2 + x[1] ** 2 - 100,
            lambda x: [10 + x[1] - 10 * x[0]],
            lower=[2, -50],
            upper=50,
            optimum=-99.96,
        ),
        Analytic(
            "HS22",
            [2, 2],
            lambda x: (x[0] - 2) ** 2 + (x[1] - 1) ** 2,
            lambda x: [x[0] + x[1] - 2, x[0] ** 2 - x[1]],
            optimum=1,
        ),
        Analytic(
            "HS23",
            [3, 1],
            lambda x: x[0] ** 2 + x[1] ** 2,
            lambda x: [
                1 - x[0] - x[1],
                1 - x[0] ** 2 - x[1] ** 2,
                9 - 9 * x[0] ** 2 - x[1] ** 2,
                x[1] - x[0] ** 2,
                x[0] - x[1] ** 2,
            ],
            lower=-50,
            upper=50,
            optimum=2,
        ),
        Analytic(
            "HS24",
            [1, 0.5],
            lambda x: ((x[0] - 3) ** 2 - 9) * x[1] ** 3 / (27 * np.sqrt(3)),
            lambda x: [x[1] - x[0] / np.sqrt(3), -x[0] - np.sqrt(3) * x[1], x[0] + np.sqrt(3) * x[1] - 6],
            lower=0,
            optimum=-1,
        ),
    ]


def three_variables() -> list[Analytic]:
    def volume(x):
        return -x[0] * x[1] * x[2]

    def hs35(x):
        return (
            9
            - 8 * x[0]
            - 6 * x[1]
            - 4 * x[2]
            + 2 * x[0] ** 2
            + 2 * x[1] ** 2
            + x[2] ** 2
            + 2 * x[0] * x[1]
            + 2 * x[0] * x[2]
        )

    def exponentials(x):
        return [exp(x[0]) - x[1], exp(x[1]) - x[2]]

    return [
        Analytic(
            "HS29",
            [1, 1, 1],
            volume,
            lambda x: [x[0] ** 2 + 2 * x[1] ** 2 + 4 * x[2] ** 2 - 48],
            optimum=-16 * np.sqrt(2),
        ),
        Analytic(
            "HS30",
            [1, 1, 1],
            lambda x: (x**2).sum(),
            lambda x: [1 - x[0] ** 2 - x[1] ** 2],
            lower=[1, -10, -10],
            upper=10,
            optimum=1,
        ),
        Analytic(
            "HS31",
            [1, 1, 1],
            lambda x: 9 * x[0] ** 2 + x[1] ** 2 + 9 * x[2] ** 2,
            lambda x: [1 - x[0] * x[1]],
            lower=[-10, 1, -10],
            upper=[10, 10, 1],
            optimum=6,
        ),
        Analytic(
            "HS33",
            [0, 0, 3],
            lambda x: (x[0] - 1) * (x[0] - 2) * (x[0] - 3) + x[2],
            lambda x: [x[0] ** 2 + x[1] ** 2 - x[2] ** 2, 4 - (x**2).sum()],
            lower=0,
            upper=[np.inf, np.inf, 5],
            optimum=np.sqrt(2) - 6,
            local=[-4],
        ),
        Analytic(
            "HS34",
            [0, 1.05, 2.9],
            lambda x: -x[0],
            exponentials,
            lower=0,
            upper=[100, 100, 10],
            optimum=-np.log(np.log(10)),
        ),
        Analytic("HS35", [0.5] * 3, hs35, lambda x: [x[0] + x[1] + 2 * x[2] - 3], lower=0, optimum=1 / 9),
        Analytic(
            "HS36",
            [10] * 3,
            volume,
            lambda x: [x[0] + 2 * x[1] + 2 * x[2] - 72],
            lower=0,
            upper=[20, 11, 42],
            optimum=-3300,
        ),
        Analytic(
            "HS37",
            [10] * 3,
            volume,
            lambda x: [x[0] + 2 * x[1] + 2 * x[2] - 72, -x[0] - 2 * x[1] - 2 * x[2]],
            lower=0,
            upper=42,
            optimum=-3456,
        ),
        Analytic(
            "HS64",
            [1] * 3,
            lambda x: 5 * x[0] + 5e4 / x[0] + 20 * x[1] + 7.2e4 / x[1] + 10 * x[2] + 1.44e5 / x[2],
            lambda x: [4 / x[0] + 32 / x[1] + 120 / x[2] - 1],
            lower=1e-5,
            optimum=6299.842428,
        ),
        Analytic(
            "HS65",
            [-5, 5, 0],
            lambda x: (x[0] - x[1]) ** 2 + (x[0] + x[1] - 10) ** 2 / 9 + (x[2] - 5) ** 2,
            lambda x: [(x**2).sum() - 48],
            lower=[-4.5, -4.5, -5],
            upper=[4.5, 4.5, 5],
            optimum=0.9535288567,
        ),
        Analytic(
            "HS66",
            [0, 1.05, 2.9],
            lambda x: 0.2 * x[2] - 0.8 * x[0],
            exponentials,
            lower=0,
            upper=[100, 100, 10],
            optimum=0.5181632741,
        ),
    ]


def hock_schittkowski() -> list[Analytic]:
    return [*bounded(), *two_variables(), *three_variables(), *four_and_five_variables(), *many_variables()]
