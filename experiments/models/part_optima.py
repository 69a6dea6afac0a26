"""Optima of the ordinary parts (experiments/models/parts) that no search has made.

Optima of static limits, critical speeds and frequencies are those of closed forms of thin walls and slender beams, which are
written here without the program; those of the three motions are scans over a family of designs that contains the best one.
Checked in tests/experiments/test_parts.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import scipy.linalg
from scipy.optimize import root_scalar

import experiments.models.parts
import torchmbd as mbd

FOLDER = Path(experiments.models.parts.__file__).parent
GRAVITY, DENSITY, BLADE = 9.81, 1586.0, 61.5  # [m/s2], of carbon [kg/m3], length [m]
CARBON, GLASS = (128e9, 10.1e9, 5.36e9, 0.23), (39e9, 8.6e9, 3.8e9, 0.28)  # E1, E2, G12, nu12


def plane_stiffness(theta: float, ply: Sequence[float] = CARBON) -> np.ndarray:
    """Stiffness [3, 3] of a ply in plane stress, in wall axes [Pa]."""
    E1, E2, G12, nu = ply
    d = 1.0 - nu**2 * E2 / E1
    Q = np.array([[E1 / d, nu * E2 / d, 0.0], [nu * E2 / d, E2 / d, 0.0], [0.0, 0.0, G12]])
    c, s = math.cos(theta), math.sin(theta)
    T = np.array([[c * c, s * s, -2 * c * s], [s * s, c * c, 2 * c * s], [c * s, -c * s, c * c - s * s]])
    return T @ Q @ T.T


def wall_moduli(theta: float, ply: Sequence[float] = CARBON) -> tuple[float, float]:
    """Moduli of a wall of plies at +theta and -theta along it and in shear, without forces across it [Pa]."""
    a = np.linalg.inv(0.5 * (plane_stiffness(theta, ply) + plane_stiffness(-theta, ply)))
    return 1.0 / a[0, 0], 1.0 / a[2, 2]


def lightest(designs: Iterable[float], mass: Callable[[float, float], float], limit: Callable[[float, float], float]):
    """Least mass over angles, each with the ply thickness [m] at which `limit`, falling with it, is 0."""
    return min(mass(theta, root_scalar(partial(limit, theta), bracket=(2e-4, 3e-3)).root) for theta in designs)


def shaft_mass(problem: mbd.Problem) -> float:
    """A thin tube on two bearings with a disk in its middle: bending and shear of slender beams."""
    length, radius, disk, bearing, speed = 1.2, 0.03, 3.0, 5e7, 350.0

    def mass(theta: float, t: float) -> float:
        return DENSITY * 2.0 * math.pi * (radius - t) * 2 * t * length

    def limit(theta: float, t: float) -> float:
        E, G = wall_moduli(theta)
        area = 2.0 * math.pi * (radius - t) * 2 * t
        bending = length**3 / (48.0 * E * 0.5 * area * (radius - t) ** 2)
        compliance = bending + length / (4.0 * 0.5 * G * area) + 0.5 / bearing
        return speed**2 * compliance * (disk + 17.0 / 35.0 * mass(theta, t)) - 1.0

    return lightest(np.deg2rad(np.arange(0.0, 15.0, 0.5)), mass, limit)


def boom_mass(problem: mbd.Problem) -> float:
    """A channel of thin walls: Saint-Venant's torsion about its shear center, bending and shear of the web."""
    length, load, width, height = 1.0, GRAVITY * 1.0, 0.03, 0.06

    def mass(theta: float, t: float) -> float:
        return DENSITY * 4 * t * (height - 4 * t + 2 * (width - 2 * t)) * length

    def limit(theta: float, t: float) -> float:
        E, G = wall_moduli(theta)
        T = 4 * t
        b, h = width - T / 2, height - T
        plies = zip((theta, -theta, -theta, theta), (-1.5 * t, -0.5 * t, 0.5 * t, 1.5 * t), strict=True)
        D = sum((plane_stiffness(angle) * (t * z**2 + t**3 / 12.0) for angle, z in plies), start=np.zeros((3, 3)))
        torsion = 4.0 * (D[2, 2] - D[1, 2] ** 2 / D[1, 1]) * (h + 2 * b)
        I = T * h**2 * (h / 12.0 + b / 2.0)
        web = -width / 2 + T / 2
        shear_center = web - b**2 * h**2 * T / (4.0 * I)
        weight = mass(theta, t) * GRAVITY
        twist = (-shear_center * load + (web + b**2 / (h + 2 * b) - shear_center) * weight / 2) * length / torsion
        sag = (load / 3.0 + weight / 8.0) * length**3 / (E * I) + (load + weight / 2) * length / (G * T * h)
        return max(twist / math.radians(0.5), sag / 7e-4) - 1.0

    return lightest(np.deg2rad(np.arange(10.0, 40.0, 0.5)), mass, limit)


def box_mass(problem: mbd.Problem) -> float:
    """A box of thin walls, one web of glass: shear flow without twist, torsion of Bredt; flanges at 0 degrees."""
    length, load, width, height = 1.5, GRAVITY * 20.0, 0.1, 0.05

    def weights(t: float) -> np.ndarray:
        """Per length, of both flanges and of each web [N/m]."""
        b, h = width - 2 * t, height - 2 * t
        return GRAVITY * 2 * t * np.array([2 * DENSITY * b, DENSITY * h, 2100.0 * h])

    def limit(theta: float, t: float) -> float:
        T, b, h = 2 * t, width - 2 * t, height - 2 * t
        flange, right, left = wall_moduli(0.0), wall_moduli(theta), wall_moduli(theta, GLASS)
        E = np.array([flange[0], right[0], flange[0], left[0]]) * T
        G = np.array([flange[1], right[1], flange[1], left[1]]) * T
        bending = (E[0] + E[2]) * b * h**2 / 4.0 + (E[1] + E[3]) * h**3 / 12.0
        # Shear flow of a unit force along z, from the lower left corner around: bottom, right, top, left.
        s = (np.arange(200) + 0.5) / 200
        z = np.stack([0 * s - h / 2, h * (s - 0.5), 0 * s + h / 2, h * (0.5 - s)])
        step = np.array([b, h, b, h])[:, None] / len(s)
        q = np.cumsum((-E[:, None] * z / bending * step).ravel()).reshape(z.shape)
        round_trip = (step * len(s) / G[:, None]).sum()
        q = q - (q * step / G[:, None]).sum() / round_trip
        shear_center = (b / 2 * q[1].sum() + b / 2 * q[3].sum()) * step[1, 0] + h / 2 * (q[0] + q[2]).sum() * step[0, 0]
        w = weights(t)
        center = (w[1] - w[2]) * b / 2 / w.sum()
        twist = (-shear_center * load + (center - shear_center) * w.sum() * length / 2) * length
        twist *= round_trip / (4.0 * (b * h) ** 2)
        shear = (q**2 * step / G[:, None]).sum()
        sag = (load / 3.0 + w.sum() * length / 8.0) * length**3 / bending + (
            load + w.sum() * length / 2
        ) * length * shear
        return max(abs(twist) / math.radians(0.03), sag / 5e-3) - 1.0

    return lightest(np.deg2rad(np.arange(0.0, 45.0, 1.0)), lambda theta, t: weights(t).sum() / GRAVITY * length, limit)


def leaf_energy(problem: mbd.Problem) -> float:
    """A strip with its fibers along it, as thin as its frequency allows, bent as far as crank and coupler swing its tip."""
    length, width, crank, coupler, frequency = 0.2, 0.03, 0.01, 0.15, 60.0
    thickness = 2.0 * math.pi * frequency * length**2 / 1.8751041**2 * math.sqrt(12.0 * DENSITY / CARBON[0])
    turn = np.linspace(0.0, 2.0 * math.pi, 2001)
    tip = np.sqrt(coupler**2 - (crank * (1.0 - np.cos(turn))) ** 2) - coupler - crank * np.sin(turn)
    return 0.5 * 3.0 * CARBON[0] * width * thickness**3 / 12.0 / length**3 * float((tip**2).max())


def blade_table() -> np.ndarray:
    return np.loadtxt(FOLDER / "nrel_5mw_blade.csv", delimiter=",")


def blade_frequency(tip: float, column: int = 2, elements: int = 48) -> float:
    """First frequency [Hz] of a slender blade with a mass at its tip [kg], by cubic elements."""
    table, h = blade_table(), BLADE / elements
    K, M = np.zeros((2, 2 * elements + 2, 2 * elements + 2))
    for e in range(elements):
        i = slice(2 * e, 2 * e + 4)
        for x, weight in zip(*np.polynomial.legendre.leggauss(4), strict=True):
            s = 0.5 * (x + 1.0)
            stiffness, mass = (np.interp((e + s) / elements, table[:, 0], table[:, k]) for k in (column, 1))
            N = np.array([1 - 3 * s**2 + 2 * s**3, h * (s - 2 * s**2 + s**3), 3 * s**2 - 2 * s**3, h * (s**3 - s**2)])
            B = np.array([-6 + 12 * s, h * (-4 + 6 * s), 6 - 12 * s, h * (6 * s - 2)]) / h**2
            K[i, i] += 0.5 * weight * h * stiffness * np.outer(B, B)
            M[i, i] += 0.5 * weight * h * mass * np.outer(N, N)
    M[-2, -2] += tip
    return math.sqrt(scipy.linalg.eigh(K[2:, 2:], M[2:, 2:], eigvals_only=True)[0]) / (2.0 * math.pi)


def tube_mass(design: Sequence[float]) -> float:
    radii = [0.030 - 0.015 * (i + 0.5) / 4 for i in range(4)]
    return sum(DENSITY * 2.0 * math.pi * (r - 1.5 * design[0]) * 3.0 * design[0] * 0.3 for r in radii)


def jib_mass(design: Sequence[float]) -> float:
    wall = 2.0 * design[0]
    return DENSITY * 3.0 * wall * (2 * 0.08 + 0.12 - 2 * wall)


def panel_mass(design: Sequence[float]) -> float:
    return 0.8 * 0.5 * (DENSITY * (design[0] + design[2]) + 60.0 * design[1])


def least_of_scan(problem: mbd.Problem, lines: Sequence[np.ndarray], mass: Callable[[Sequence[float]], float]) -> float:
    """Least mass over lines of designs, each where it meets the limits, between two designs on a straight line."""
    masses = []
    for line in lines:
        evaluations = problem.evaluate(line, False)
        assert all(e.ok for e in evaluations)
        violation = np.array([e.constraints.max() for e in evaluations])
        assert violation[0] > 0.0 > violation[-1]
        k = int(np.argmax(violation <= 0.0))
        share = violation[k - 1] / (violation[k - 1] - violation[k])
        masses.append(mass(line[k - 1] + share * (line[k] - line[k - 1])))
    return min(masses)


def scan_of_tubes(problem: mbd.Problem) -> float:
    line = np.array([[wall, 0.0, 0.0, 0.0] for wall in np.linspace(0.125e-3, 0.135e-3, 3)])
    return least_of_scan(problem, [line], tube_mass)


def scan_of_jibs(problem: mbd.Problem) -> float:
    """Flanges along the jib, webs at a pair of angles."""
    webs, walls = np.deg2rad([8.0, 16.0, 24.0]), np.linspace(3.0e-3, 3.4e-3, 3)
    return least_of_scan(problem, [np.array([[w, 0, 0, a, -a, 0, 0] for w in walls]) for a in webs], jib_mass)


def scan_of_panels(problem: mbd.Problem) -> float:
    """Equal skins, cores from thin to thick."""
    skins, cores = np.linspace(0.11e-3, 0.14e-3, 3), np.linspace(12.5e-3, 15.5e-3, 4)
    return least_of_scan(problem, [np.array([[s, c, s] for c in cores]) for s in skins], panel_mass)


MASSES = {"tube_arm": tube_mass, "crane_jib": jib_mass, "sandwich_panel": panel_mass}
OPTIMA: dict[str, Callable[[mbd.Problem], float]] = {
    "tube_arm": scan_of_tubes,
    "crane_jib": scan_of_jibs,
    "sandwich_panel": scan_of_panels,
    "leaf_linkage": leaf_energy,
    "drive_shaft": shaft_mass,
    "channel_boom": boom_mass,
    "box_beam": box_mass,
    "turbine_blade": lambda problem: root_scalar(lambda tip: blade_frequency(tip) - 0.5, bracket=(0.0, 2000.0)).root,
}
