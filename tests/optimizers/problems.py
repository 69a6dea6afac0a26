"""Problems with known optima.

Source: Hock and Schittkowski, Test Examples for Nonlinear Programming Codes, Lecture Notes in Economics and Mathematical
Systems 187 (1981): the numbers are theirs, every constraint is turned to c(x) <= 0, a start outside the bounds is moved onto them.
`local` lists other local minima (objective) where a local method may rightly end.
"""

from __future__ import annotations

import numpy as np
from numpy import exp, log, sin, sqrt

from tests.optimizers.analytic import Analytic


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
        Analytic("HS10", [-10, 10], lambda x: x[0] - x[1], lambda x: [3 * x[0] ** 2 - 2 * x[0] * x[1] + x[1] ** 2 - 1], optimum=-1),
        Analytic("HS11", [4.9, 0.1], lambda x: (x[0] - 5) ** 2 + x[1] ** 2 - 25, lambda x: [x[0] ** 2 - x[1]], optimum=-8.498464223),
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
            9 - 8 * x[0] - 6 * x[1] - 4 * x[2] + 2 * x[0] ** 2 + 2 * x[1] ** 2 + x[2] ** 2 + 2 * x[0] * x[1] + 2 * x[0] * x[2]
        )

    def exponentials(x):
        return [exp(x[0]) - x[1], exp(x[1]) - x[2]]

    return [
        Analytic("HS29", [1, 1, 1], volume, lambda x: [x[0] ** 2 + 2 * x[1] ** 2 + 4 * x[2] ** 2 - 48], optimum=-16 * np.sqrt(2)),
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
        Analytic("HS34", [0, 1.05, 2.9], lambda x: -x[0], exponentials, lower=0, upper=[100, 100, 10], optimum=-np.log(np.log(10))),
        Analytic("HS35", [0.5] * 3, hs35, lambda x: [x[0] + x[1] + 2 * x[2] - 3], lower=0, optimum=1 / 9),
        Analytic("HS36", [10] * 3, volume, lambda x: [x[0] + 2 * x[1] + 2 * x[2] - 72], lower=0, upper=[20, 11, 42], optimum=-3300),
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


def four_and_five_variables() -> list[Analytic]:
    def hs43_f(x):
        return (x**2).sum() + x[2] ** 2 - 5 * x[0] - 5 * x[1] - 21 * x[2] + 7 * x[3]

    def hs43_c(x):
        return [
            (x**2).sum() + x[0] - x[1] + x[2] - x[3] - 8,
            x[0] ** 2 + 2 * x[1] ** 2 + x[2] ** 2 + 2 * x[3] ** 2 - x[0] - x[3] - 10,
            2 * x[0] ** 2 + x[1] ** 2 + x[2] ** 2 + 2 * x[0] - x[1] - x[3] - 5,
        ]

    def hs44_f(x):
        return x[0] - x[1] - x[2] - x[0] * x[2] + x[0] * x[3] + x[1] * x[2] - x[1] * x[3]

    def hs44_c(x):
        return [
            x[0] + 2 * x[1] - 8,
            4 * x[0] + x[1] - 12,
            3 * x[0] + 4 * x[1] - 12,
            2 * x[2] + x[3] - 8,
            x[2] + 2 * x[3] - 8,
            x[2] + x[3] - 5,
        ]

    def hs72_c(x):
        return [
            4 / x[0] + 2.25 / x[1] + 1 / x[2] + 0.25 / x[3] - 0.0401,
            0.16 / x[0] + 0.36 / x[1] + 0.64 * (1 / x[2] + 1 / x[3]) - 0.010085,
        ]

    def hs76_f(x):
        squares = x[0] ** 2 + 0.5 * x[1] ** 2 + x[2] ** 2 + 0.5 * x[3] ** 2
        return squares - x[0] * x[2] + x[2] * x[3] - x[0] - 3 * x[1] + x[2] - x[3]

    def hs76_c(x):
        return [x[0] + 2 * x[1] + x[2] + x[3] - 5, 3 * x[0] + x[1] + 2 * x[2] - x[3] - 4, 1.5 - x[1] - 4 * x[2]]

    def hs83_c(x):
        a = 85.334407 + 0.0056858 * x[1] * x[4] + 0.0006262 * x[0] * x[3] - 0.0022053 * x[2] * x[4]
        b = 80.51249 + 0.0071317 * x[1] * x[4] + 0.0029955 * x[0] * x[1] + 0.0021813 * x[2] ** 2
        c = 9.300961 + 0.0047026 * x[2] * x[4] + 0.0012547 * x[0] * x[2] + 0.0019085 * x[2] * x[3]
        return [-a, a - 92, 90 - b, b - 110, 20 - c, c - 25]

    return [
        Analytic("HS43", [0] * 4, hs43_f, hs43_c, optimum=-44),
        Analytic("HS44", [0] * 4, hs44_f, hs44_c, lower=0, optimum=-15, local=[-13]),
        Analytic("HS72", [1] * 4, lambda x: 1 + x.sum(), hs72_c, lower=0.001, upper=[4e5, 3e5, 2e5, 1e5], optimum=727.67937),
        Analytic("HS76", [0.5] * 4, hs76_f, hs76_c, lower=0, optimum=-4.681818181),
        Analytic(
            "HS83",
            [78, 33, 27, 27, 27],
            lambda x: 5.3578547 * x[2] ** 2 + 0.8356891 * x[0] * x[4] + 37.293239 * x[0] - 40792.141,
            hs83_c,
            lower=[78, 33, 27, 27, 27],
            upper=[102, 45, 45, 45, 45],
            optimum=-30665.53867,
        ),
        colville_one(),
    ]


COLVILLE_C = np.array(
    [[30, -20, -10, 32, -10], [-20, 39, -6, -31, 32], [-10, -6, 10, -6, -10], [32, -31, -6, 39, -20], [-10, 32, -10, -20, 30]]
)
COLVILLE_A = np.array(
    [
        [-16, 2, 0, 1, 0],
        [0, -2, 0, 0.4, 2],
        [-3.5, 0, 2, 0, 0],
        [0, -2, 0, -4, -1],
        [0, -9, -2, 1, -2.8],
        [2, 0, -4, 0, 0],
        [-1, -1, -1, -1, -1],
        [-1, -2, -3, -2, -1],
        [1, 2, 3, 4, 5],
        [1, 1, 1, 1, 1],
    ]
)
COLVILLE_B = np.array([-40, -2, -0.25, -4, -4, -1, -40, -60, 5, 1])
COLVILLE_D, COLVILLE_E = np.array([4, 8, 10, 6, 2]), np.array([-15, -27, -36, -18, -12])


def colville_one() -> Analytic:
    return Analytic(
        "HS86",
        [0, 0, 0, 0, 1],
        lambda x: COLVILLE_E @ x + x @ COLVILLE_C @ x + COLVILLE_D @ x**3,
        lambda x: COLVILLE_B - COLVILLE_A @ x,
        lower=0,
        optimum=-32.34867897,
    )


def many_variables() -> list[Analytic]:
    def hs93_f(x):
        p, q = x[0] * x[3] * (x[0] + x[1] + x[2]), x[1] * x[2] * (x[0] + 1.57 * x[1] + x[3])
        return 0.0204 * p + 0.0187 * q + 0.0607 * p * x[4] ** 2 + 0.0437 * q * x[5] ** 2

    def hs93_c(x):
        p, q = x[0] * x[3] * (x[0] + x[1] + x[2]), x[1] * x[2] * (x[0] + 1.57 * x[1] + x[3])
        return [2.07 - 0.001 * x.prod(), 0.00062 * p * x[4] ** 2 + 0.00058 * q * x[5] ** 2 - 1]

    def hs100_f(x):
        return (
            (x[0] - 10) ** 2
            + 5 * (x[1] - 12) ** 2
            + x[2] ** 4
            + 3 * (x[3] - 11) ** 2
            + 10 * x[4] ** 6
            + 7 * x[5] ** 2
            + x[6] ** 4
            - 4 * x[5] * x[6]
            - 10 * x[5]
            - 8 * x[6]
        )

    def hs100_c(x):
        return [
            2 * x[0] ** 2 + 3 * x[1] ** 4 + x[2] + 4 * x[3] ** 2 + 5 * x[4] - 127,
            7 * x[0] + 3 * x[1] + 10 * x[2] ** 2 + x[3] - x[4] - 282,
            23 * x[0] + x[1] ** 2 + 6 * x[5] ** 2 - 8 * x[6] - 196,
            4 * x[0] ** 2 + x[1] ** 2 - 3 * x[0] * x[1] + 2 * x[2] ** 2 + 5 * x[5] - 11 * x[6],
        ]

    def hs104_f(x):
        return 0.4 * (x[0] / x[6]) ** 0.67 + 0.4 * (x[1] / x[7]) ** 0.67 + 10 - x[0] - x[1]

    def hs104_c(x):
        f = hs104_f(x)
        return [
            0.0588 * x[4] * x[6] + 0.1 * x[0] - 1,
            0.0588 * x[5] * x[7] + 0.1 * x[0] + 0.1 * x[1] - 1,
            4 * x[2] / x[4] + 2 * x[2] ** -0.71 / x[4] + 0.0588 * x[2] ** -1.3 * x[6] - 1,
            4 * x[3] / x[5] + 2 * x[3] ** -0.71 / x[5] + 0.0588 * x[3] ** -1.3 * x[7] - 1,
            1 - f,
            f - 4.2,
        ]

    def hs106_c(x):
        return [
            0.0025 * (x[3] + x[5]) - 1,
            0.0025 * (x[4] + x[6] - x[3]) - 1,
            0.01 * (x[7] - x[4]) - 1,
            833.33252 * x[3] + 100 * x[0] - 83333.333 - x[0] * x[5],
            1250 * x[4] + x[1] * x[3] - 1250 * x[3] - x[1] * x[6],
            1250000 + x[2] * x[4] - 2500 * x[4] - x[2] * x[7],
        ]

    def hs113_f(x):
        return (
            x[0] ** 2
            + x[1] ** 2
            + x[0] * x[1]
            - 14 * x[0]
            - 16 * x[1]
            + (x[2] - 10) ** 2
            + 4 * (x[3] - 5) ** 2
            + (x[4] - 3) ** 2
            + 2 * (x[5] - 1) ** 2
            + 5 * x[6] ** 2
            + 7 * (x[7] - 11) ** 2
            + 2 * (x[8] - 10) ** 2
            + (x[9] - 7) ** 2
            + 45
        )

    def hs113_c(x):
        return [
            4 * x[0] + 5 * x[1] - 3 * x[6] + 9 * x[7] - 105,
            10 * x[0] - 8 * x[1] - 17 * x[6] + 2 * x[7],
            -8 * x[0] + 2 * x[1] + 5 * x[8] - 2 * x[9] - 12,
            3 * (x[0] - 2) ** 2 + 4 * (x[1] - 3) ** 2 + 2 * x[2] ** 2 - 7 * x[3] - 120,
            5 * x[0] ** 2 + 8 * x[1] + (x[2] - 6) ** 2 - 2 * x[3] - 40,
            0.5 * (x[0] - 8) ** 2 + 2 * (x[1] - 4) ** 2 + 3 * x[4] ** 2 - x[5] - 30,
            x[0] ** 2 + 2 * (x[1] - 2) ** 2 - 2 * x[0] * x[1] + 14 * x[4] - 6 * x[5],
            -3 * x[0] + 6 * x[1] + 12 * (x[8] - 8) ** 2 - 7 * x[9],
        ]

    def hs117_f(x):
        return -COLVILLE_B @ x[:10] + x[10:] @ COLVILLE_C @ x[10:] + 2 * COLVILLE_D @ x[10:] ** 3

    def hs117_c(x):
        return COLVILLE_A.T @ x[:10] - 2 * COLVILLE_C @ x[10:] - 3 * COLVILLE_D * x[10:] ** 2 - COLVILLE_E

    return [
        Analytic("HS93", [5.54, 4.4, 12.02, 11.8, 0.702, 0.852], hs93_f, hs93_c, lower=0, optimum=135.075961),
        alkylation("HS95", [4.97, -1.88, -29.08, -78.02], 0.015619514),
        alkylation("HS96", [4.97, -1.88, -69.08, -118.02], 0.015619513),
        alkylation("HS97", [32.97, 25.12, -29.08, -78.02], 3.1358091, local=[4.0712464]),
        alkylation("HS98", [32.97, 25.12, -124.08, -173.02], 3.1358091, local=[4.0712464]),
        Analytic("HS100", [1, 2, 0, 4, 0, 1, 1], hs100_f, hs100_c, optimum=680.6300573),
        Analytic("HS104", [6, 3, 0.4, 0.2, 6, 6, 1, 0.5], hs104_f, hs104_c, lower=0.1, upper=10, optimum=3.9511634396),
        Analytic(
            "HS106",
            [5000, 5000, 5000, 200, 350, 150, 225, 425],
            lambda x: x[0] + x[1] + x[2],
            hs106_c,
            lower=[100, 1000, 1000, 10, 10, 10, 10, 10],
            upper=[10000] * 3 + [1000] * 5,
            optimum=7049.24802,
        ),
        Analytic("HS113", [2, 3, 5, 5, 1, 2, 7, 3, 6, 10], hs113_f, hs113_c, optimum=24.3062091),
        Analytic("HS117", [0.001] * 6 + [60] + [0.001] * 8, hs117_f, hs117_c, lower=0, optimum=32.348679),
    ]


def alkylation(name: str, b: list[float], optimum: float, local: list[float] | None = None) -> Analytic:
    def c(x):
        return [
            b[0]
            - (
                np.array([17.1, 38.2, 204.2, 212.3, 623.4, 1495.5]) @ x
                - 169 * x[0] * x[2]
                - 3580 * x[2] * x[4]
                - 3810 * x[3] * x[4]
                - 18500 * x[3] * x[5]
                - 24300 * x[4] * x[5]
            ),
            b[1]
            - (
                np.array([17.9, 36.8, 113.9, 169.7, 337.8, 1385.2]) @ x
                - 139 * x[0] * x[2]
                - 2450 * x[3] * x[4]
                - 16600 * x[3] * x[5]
                - 17200 * x[4] * x[5]
            ),
            b[2] - (-273 * x[1] - 70 * x[3] - 819 * x[4] + 26000 * x[3] * x[4]),
            b[3] - (159.9 * x[0] - 311 * x[1] + 587 * x[3] + 391 * x[4] + 2198 * x[5] - 14000 * x[0] * x[5]),
        ]

    cost = np.array([4.3, 31.8, 63.3, 15.8, 68.5, 4.7])
    upper = [0.31, 0.046, 0.068, 0.042, 0.028, 0.0134]
    return Analytic(name, [0] * 6, lambda x: cost @ x, c, lower=0, upper=upper, optimum=optimum, local=local or [])


def three_bar_truss() -> Analytic:
    """Weight of the symmetric three-bar truss under two loads of 20; allowable stresses +20 and -15 (Vanderplaats)."""

    def c(x):
        determinant = sqrt(2) * x[0] ** 2 + 2 * x[0] * x[1]
        return [
            (sqrt(2) * x[0] + x[1]) / determinant - 1,
            1 / (x[0] + sqrt(2) * x[1]) - 1,
            20 * x[1] / determinant / 15 - 1,
        ]

    return Analytic("three-bar truss", [1, 1], lambda x: 2 * sqrt(2) * x[0] + x[1], c, lower=0.01, upper=10, optimum=2.638958434)


def cantilever(segments: int = 5) -> Analytic:
    """Volume [cm3] of Vanderplaats' stepped cantilever: b, h of each segment [cm], tip load 50 kN, stress, tip deflection, h <= 20 b.

    Deflection and slope of each segment by beam theory, added up from the clamp. Optimum of five segments as in Thanedar and
    Vanderplaats, Survey of discrete variable optimization, J. Struct. Eng. 121 (1995): 63,110 cm3, two further digits by SLSQP and
    trust-constr in agreement.
    """
    load, modulus, length, allowable, tip = 5e4, 2e7, 500.0, 14000.0, 2.5
    part = length / segments

    def f(x):
        return part * (x[:segments] * x[segments:]).sum()

    def c(x):
        b, h = x[:segments], x[segments:]
        inertia = b * h**3 / 12
        stress, slope, deflection = [], 0.0, 0.0
        for i in range(segments):
            moment = load * (length - i * part)
            stress.append(moment * h[i] / (2 * inertia[i]) / allowable - 1)
            end = length - (i + 1) * part
            deflection += slope * part + load * part**2 / (2 * modulus * inertia[i]) * (end + 2 * part / 3)
            slope += load * part / (modulus * inertia[i]) * (end + part / 2)
        return [*stress, deflection / tip - 1, *(h / (20 * b) - 1)]

    start = [5.0] * segments + [40.0] * segments
    lower, upper = [1.0] * segments + [5.0] * segments, [10.0] * segments + [100.0] * segments
    return Analytic("cantilever", start, f, c, lower=lower, upper=upper, optimum=65419.6589)


def hock_schittkowski() -> list[Analytic]:
    return [*bounded(), *two_variables(), *three_variables(), *four_and_five_variables(), *many_variables()]
