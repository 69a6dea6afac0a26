"""Sizing problems of Vanderplaats' book, the everyday use of a feasible directions method."""

from __future__ import annotations

from numpy import sqrt

from tests.optimization.analytic import Analytic


def three_bar_truss() -> Analytic:
    """Weight of the symmetric three-bar truss under two loads of 20; allowable stresses +20 and -15 (Vanderplaats)."""

    def c(x):
        determinant = sqrt(2) * x[0] ** 2 + 2 * x[0] * x[1]
        return [
            (sqrt(2) * x[0] + x[1]) / determinant - 1,
            1 / (x[0] + sqrt(2) * x[1]) - 1,
            20 * x[1] / determinant / 15 - 1,
        ]

    return Analytic(
        "three-bar truss", [1, 1], lambda x: 2 * sqrt(2) * x[0] + x[1], c, lower=0.01, upper=10, optimum=2.638958434
    )


def cantilever(segments: int = 5) -> Analytic:
    """Volume [cm3] of Vanderplaats' stepped cantilever: widths and heights of the segments [cm], tip load 50 kN.

    Stress at each clamped side, deflection of the tip, h <= 20 b.

    Deflection and slope of each segment by beam theory, added up from the clamp. Optimum: three optimizers of SciPy and
    NLopt agree on these digits.
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
