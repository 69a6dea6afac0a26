"""Rate and level of the membrane with drilling: a rectangle with the displacements of a cubic field at its edges.

Plane stress without body force, isotropic, E = 1, with k = (1 - nu) / 2 and s = (1 + nu) / 2:
    u = p x^3 + q x y^2,   v = -(p y^3 + q y x^2),   6 p + 2 k q - 2 s q = 0
balances: u,xx + k u,yy + s v,xy = 0. The edges get the exact displacements and rotations; the energy is compared.
"""

import math

import numpy as np
import pytest

from tests.fem.elements.plate_cases import KINDS, boundary, freedoms, irregular, solved, stiffness
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply

NU = 0.3
Q = 1.0
P = Q * NU / 3
LENGTH, WIDTH = 2.0, 1.6


def exact_energy():
    """Integral of the strain energy density by Gauss points (the density has degree 4)."""
    points, weights = np.polynomial.legendre.leggauss(4)
    x, y = np.meshgrid(points * LENGTH / 2, points * WIDTH / 2, indexing="ij")
    eps = np.stack([3 * P * x**2 + Q * y**2, -(3 * P * y**2 + Q * x**2), 2 * Q * x * y - 2 * Q * x * y])
    law = np.array([[1, NU, 0], [NU, 1, 0], [0, 0, (1 - NU) / 2]]) / (1 - NU**2)
    density = np.einsum("aij,ab,bij->ij", eps, law, eps) / 2
    return LENGTH * WIDTH / 4 * weights @ density @ weights


def found_energy(n, amount, kind):
    mesh = irregular(LENGTH, WIDTH, (n, n), amount=amount, kind=kind)
    laminate = Laminate(Ply.isotropic(1.0, NU, 1.0), [0.0], 1.0)
    x, y = mesh.nodes[:, 0].numpy(), mesh.nodes[:, 1].numpy()
    given = np.zeros((len(x), 6))
    given[:, 0], given[:, 1], given[:, 5] = P * x**3 + Q * x * y**2, -(P * y**3 + Q * y * x**2), -2 * Q * x * y
    held = np.union1d(freedoms(boundary(mesh), [0, 1, 5]), freedoms(range(len(x)), [2, 3, 4]))
    K = stiffness(PlateMatrices(mesh, laminate), laminate)
    u = solved(K, np.zeros(6 * len(x)), held, given.ravel())
    return u @ K @ u / 2


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("amount", [0.0, 0.15])
def test_energy_converges_quadratically(amount, kind):
    """Quadrilaterals are beyond that: of fourth order on a regular mesh, and twenty times better on an irregular one."""
    coarse, fine = (abs(found_energy(n, amount, kind) / exact_energy() - 1) for n in (16, 32))
    if kind == "quad" and amount > 0.0:
        assert fine < min(1e-4, coarse / 3)
        return
    rate = 4.0 if kind == "quad" else 2.0
    assert math.log2(coarse / fine) == pytest.approx(rate, abs=0.1)
    assert fine < 2e-3
