"""Least mass of a swinging tube of three plies, by closed formulas: a wall and three ply angles.

The axial modulus is that of the laminate. Frequency, sway and sag go with the compliance of the tube and of its hinge, and with
the mass of the tube. All fibers along the tube are best. From designs with a thick wall and fibers across the tube the
linearized constraints promise the thinnest wall, which violates them far more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tests.optimization.analytic import Analytic

E1, E2, G12, NU12 = 128e9, 10.1e9, 5.36e9, 0.3  # carbon and epoxy [Pa]
REDUCED = np.array([[E1, NU12 * E2, 0.0], [NU12 * E2, E2, 0.0], [0.0, 0.0, 0.0]]) / (1.0 - NU12**2 * E2 / E1)
REDUCED[2, 2] = G12
OPTIMUM = 0.1064795  # [kg], at 0/0/0 degrees: the wall where the sway is at its limit, found by bisection


def modulus(angles: np.ndarray) -> complex:
    """The axial modulus of plies of equal thickness over that along the fibers."""
    stiffness: np.ndarray = np.zeros((3, 3))
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        T = np.array([[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]])
        stiffness = stiffness + T.T @ REDUCED @ T / len(angles)
    return 1.0 / np.linalg.inv(stiffness)[0, 0] / E1


def constraints(x: np.ndarray) -> list[complex]:
    """A frequency, a sway and a sag of the wall x[0] [mm] with the angles x[1:]."""
    mass = 0.8017 * x[0]
    compliance = 0.1 / (x[0] * modulus(x[1:]))
    inertia = (0.3 + 0.17 * mass) / 0.3136
    period = np.sqrt((0.634 + 0.39 * compliance) * inertia)
    sag = 0.724 * compliance * (0.3 + 0.4 * mass) / 0.332
    return [1.0 - 1.0 / period, (0.702 + 0.377 * compliance) * inertia - 1.0, sag - 1.0]


def laminated_tube(start: Sequence[float]) -> Analytic:
    """The problem from a wall [mm] and three angles [rad]."""
    quarter = 0.5 * np.pi
    lower, upper = [0.1, -quarter, -quarter, -quarter], [1.0, quarter, quarter, quarter]
    return Analytic("tube", start, lambda x: 0.8017 * x[0], constraints, lower=lower, upper=upper, optimum=OPTIMUM)
