"""A geometrically exact planar beam in numpy, independent of floating frames, modes and multipliers.

    e = cos th x' + sin th y' - 1      g = - sin th x' + cos th y'      k = th'          strains along the undeformed line
    U = 1/2 integral EA e^2 + GA g^2 + EI k^2      T = 1/2 integral m (x.^2 + y.^2) + m i^2 th.^2

Unknowns are places and rotations (x, y, th) of the nodes in ground axes: of any size. Quadratic elements, two points of
Gauss for U (no locking), three for T. Freedoms may follow functions of time; the rest is an ordinary differential equation,
integrated by the method of
Hilber, Hughes and Taylor with Newton's iteration.
Source: Simo and Vu-Quoc, On the dynamics of flexible beams under large overall motions, J. Appl. Mech. 53 (1986) 849-863.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

ALPHA, ITERATIONS, TOLERANCE = 0.1, 20, 1e-11
Law = Callable[[float], tuple[float, float, float]]  # time -> value, rate, acceleration


class BeamRun(NamedTuple):
    """Times [n], places and rotations of the nodes [n, nodes, 3], strain energy [n]."""

    t: np.ndarray
    u: np.ndarray
    U: np.ndarray


@dataclass(frozen=True)
class NonlinearBeam:
    """A straight uniform beam: length [m], EA, GA [N], EI [N m2], mass per length [kg/m], radius of gyration [m]."""

    length: float
    EA: float
    GA: float
    EI: float
    mass: float
    gyration: float
    elements: int = 8

    @property
    def nodes(self) -> int:
        return 2 * self.elements + 1

    @property
    def table(self) -> np.ndarray:
        """Freedoms of each element [elements, 9]: x, y, th of its three nodes."""
        first = 6 * np.arange(self.elements)
        return first[:, None] + np.arange(9)

    def mass_matrix(self) -> np.ndarray:
        xi, weight = np.polynomial.legendre.leggauss(3)
        N, half = _shapes(xi)[0], 0.5 * self.length / self.elements
        own = half * self.mass * np.einsum("g,ga,gb->ab", weight, N, N)
        full = np.kron(own, np.diag([1.0, 1.0, self.gyration**2]))
        M = np.zeros((3 * self.nodes, 3 * self.nodes))
        for freedoms in self.table:
            M[np.ix_(freedoms, freedoms)] += full
        return M

    def elastic(self, u: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Strain energy, forces [3 nodes] and tangent [3 nodes, 3 nodes]."""
        xi, weight = np.polynomial.legendre.leggauss(2)
        N, D = _shapes(xi)
        half = 0.5 * self.length / self.elements
        weight, D = half * weight, D / half
        own = u[self.table].reshape(self.elements, 3, 3)
        slope = np.einsum("ga,eac->egc", D, own)
        c, s = (f(np.einsum("ga,ea->eg", N, own[:, :, 2])) for f in (np.cos, np.sin))
        e, g, k = c * slope[..., 0] + s * slope[..., 1] - 1.0, -s * slope[..., 0] + c * slope[..., 1], slope[..., 2]
        normal, shear, moment = self.EA * e, self.GA * g, self.EI * k
        zero, one = np.zeros_like(e), np.ones_like(e)
        # Strains by (x', y', th, k), and what their second derivatives make of the forces.
        B = np.stack([np.stack(x, -1) for x in ((c, s, g, zero), (-s, c, -1.0 - e, zero), (zero, zero, zero, one))], -2)
        stiff = np.einsum("egri,r,egrj->egij", B, [self.EA, self.GA, self.EI], B)
        for i, x in ((0, -normal * s - shear * c), (1, normal * c - shear * s)):
            stiff[..., i, 2] += x
            stiff[..., 2, i] += x
        stiff[..., 2, 2] += -normal * (1.0 + e) - shear * g
        force = np.einsum("egri,egr->egi", B, np.stack([normal, shear, moment], -1))
        P = np.zeros((2, 4, 3, 3))  # (x', y', th, k) of the nodes' (x, y, th)
        P[:, 0, :, 0], P[:, 1, :, 1], P[:, 2, :, 2], P[:, 3, :, 2] = D, D, N, D
        P = P.reshape(2, 4, 9)
        f, K = np.zeros(len(u)), np.zeros((len(u), len(u)))
        np.add.at(f, self.table, np.einsum("g,gia,egi->ea", weight, P, force))
        blocks = np.einsum("g,gia,egij,gjb->eab", weight, P, stiff, P, optimize=True)
        np.add.at(K, (self.table[:, :, None], self.table[:, None, :]), blocks)
        energy = 0.5 * (weight * (normal * e + shear * g + moment * k)).sum()
        return float(energy), f, K

    def straight(self, angle: float, velocity: tuple[float, float] = (0.0, 0.0), spin: float = 0.0) -> np.ndarray:
        """Places and rates [2, 3 nodes] of the undeformed beam from the origin, turned and moving as a rigid body."""
        x = np.linspace(0.0, self.length, self.nodes)
        c, s = np.cos(angle), np.sin(angle)
        u = np.stack([c * x, s * x, np.full_like(x, angle)], 1)
        v = np.stack([velocity[0] - spin * u[:, 1], velocity[1] + spin * u[:, 0], np.full_like(x, spin)], 1)
        return np.stack([u.ravel(), v.ravel()])

    def run(
        self,
        start: np.ndarray,
        duration: float,
        steps: int,
        held: Mapping[int, Law],
        gravity: float = 0.0,
        extra: Mapping[int, float] | None = None,
    ) -> BeamRun:
        """Motion from places and rates [2, 3 nodes]; `held`: freedom -> its law; gravity along -y; `extra`: masses."""
        M, h = self.mass_matrix(), duration / steps
        weight = M[:, 1::3].sum(1) * -gravity
        for freedom, mass in (extra or {}).items():
            M[freedom, freedom] += mass
        free = np.setdiff1d(np.arange(len(M)), list(held))
        own, old, beta, gamma = np.ix_(free, free), ALPHA, 0.25 * (1.0 + ALPHA) ** 2, 0.5 + ALPHA
        u, v, a = _held(held, 0.0, *start, np.zeros(len(M)))
        U, f, _ = self.elastic(u)
        a[free] = np.linalg.solve(M[own], (weight - f - M @ a)[free])
        kept, energies = [u], [U]
        for n in range(1, steps + 1):
            last, half = f, u + h * v + (0.5 - beta) * h * h * a
            rate = v + (1.0 - gamma) * h * a
            for _ in range(ITERATIONS):
                u, _, a = _held(held, n * h, half + beta * h * h * a, rate, a)
                U, f, K = self.elastic(u)
                missing = (weight - (1.0 - old) * f - old * last - M @ a)[free]
                step = np.linalg.solve(M[own] + (1.0 - old) * beta * h * h * K[own], missing)
                a[free] += step
                if beta * h * h * np.abs(step).max() <= TOLERANCE * self.length:
                    break
            else:
                raise ArithmeticError(f"Newton's method does not converge at t = {n * h:g} s")
            u, v, a = _held(held, n * h, half + beta * h * h * a, rate + gamma * h * a, a)
            kept.append(u)
            energies.append(U)
        shape = (steps + 1, self.nodes, 3)
        return BeamRun(np.linspace(0.0, duration, steps + 1), np.array(kept).reshape(shape), np.array(energies))


def _held(held: Mapping[int, Law], t: float, u: np.ndarray, v: np.ndarray, a: np.ndarray) -> list[np.ndarray]:
    """Places, rates and accelerations with the held freedoms where their laws have them at time t."""
    u, v, a = u.copy(), v.copy(), a.copy()
    for freedom, law in held.items():
        u[freedom], v[freedom], a[freedom] = law(t)
    return [u, v, a]


def _shapes(xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic shapes and their slopes [points, 3]."""
    N = np.stack([0.5 * xi * (xi - 1.0), 1.0 - xi * xi, 0.5 * xi * (xi + 1.0)], 1)
    return N, np.stack([xi - 0.5, -2.0 * xi, xi + 0.5], 1)
