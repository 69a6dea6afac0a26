"""Frequencies of beams against closed forms: Timoshenko's simply supported beam, and the exact coupled cantilever.

S. P. Timoshenko, On the correction for shear of the differential equation for transverse vibrations of prismatic bars,
Philos. Mag. 41 (1921) 744-746. Coupled: roots of the end condition of the exact equations (tests/fem/elements/beam_cases.py).
The lumped mass converges at second order.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import brentq

from tests.fem.elements.beam_cases import cantilever_residual, coupled_section
from torchmbd.fem.elements import Assembly, BeamLine, Beams, GivenSection
from torchmbd.math.sparse import SparseMatrix

E, NU, RHO, B, H, LENGTH = 70e9, 0.33, 2700.0, 0.03, 0.05, 0.4


def frequencies(
    section: GivenSection, elements: int, held: list[int], count: int, length: float = LENGTH, mass: str = "lumped"
) -> np.ndarray:
    """Circular frequencies [1/s] of a straight beam along x, some freedoms of the first and last node held."""
    line = BeamLine.straight(length, elements)
    assembly = Assembly(line, {"beam": Beams(line, section, mass=mass)})
    inertia = assembly.mass()
    assert isinstance(inertia, SparseMatrix)
    K, M = (A.dense().detach().numpy() for A in (assembly.stiffness(), inertia))
    free = np.setdiff1d(np.arange(len(K)), held)
    return np.sqrt(eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], subset_by_index=[0, count - 1])[0])


@pytest.mark.thorough
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_simply_supported_timoshenko_beam(mass):
    """Both bending planes, extension and torsion; thick (length over height 8)."""
    section = GivenSection.isotropic(E, NU, RHO, B * H, B * H**3 / 12, H * B**3 / 12, 2.8e-7, 0.85, 0.83)
    K, M = section.stiffness().diagonal().tolist(), section.mass().diagonal().tolist()
    exact = []
    for n in range(1, 5):
        k = n * math.pi / LENGTH
        for shear, bend, rotary in ((K[1], K[5], M[5]), (K[2], K[4], M[4])):
            k2 = np.array([[shear * k**2, -shear * k], [-shear * k, bend * k**2 + shear]])
            exact.append(math.sqrt(eigh(k2, np.diag([M[0], rotary]))[0][0]))
        for stiffness, inertia in ((K[0], M[0]), (K[3], M[3])):  # held at the start, free at the end
            exact.append((n - 0.5) * math.pi / LENGTH * math.sqrt(stiffness / inertia))
    exact = np.sort(exact)[:6]
    errors = []
    for n in (20, 40, 80):
        result = frequencies(section, n, [0, 1, 2, 3, 6 * n + 1, 6 * n + 2], 6, mass=mass)
        errors.append(np.abs(result / exact - 1))
    assert errors[-1].max() < 1.5e-3
    rates = np.log2(errors[1] / errors[2])
    assert rates == pytest.approx(np.full(6, 2.0), abs=0.1)


@pytest.mark.thorough
def test_coupled_cantilever():
    """Every stiffness and inertia coupling at work, the center of mass off the line."""
    section, length = coupled_section(), 0.6
    K, M = section.stiffness().detach(), section.mass()
    coarse, fine = (frequencies(section, n, list(range(6)), 6, length) for n in (40, 80))
    extrapolated = fine + (fine - coarse) / 3
    for omega, near in zip(extrapolated, fine, strict=True):
        low, high = 0.998 * omega, 1.002 * omega
        residual = [cantilever_residual(K, M, length, x) for x in (low, high)]
        assert residual[0] * residual[1] < 0
        exact = brentq(lambda x: cantilever_residual(K, M, length, x), low, high, rtol=np.float64(1e-12))
        assert omega == pytest.approx(exact, rel=2e-6)
        assert near == pytest.approx(exact, rel=1.5e-3)


def test_torsion_and_bending_have_their_own_inertia():
    """A slender tube: polar inertia twice the other; both waves at their speeds."""
    r, t = 0.02, 1e-3
    area, second = 2 * math.pi * r * t, math.pi * r**3 * t
    section = GivenSection.isotropic(E, NU, RHO, area, second, second, 2 * second, 0.5, 0.5)
    result = frequencies(section, 64, list(range(6)), 12, length=2.0)
    torsion = 0.5 * math.pi / 2.0 * math.sqrt(E / 2 / (1 + NU) / RHO)
    assert np.abs(result / torsion - 1).min() < 1e-4
    bending = 1.8751041**2 / 4.0 * math.sqrt(E * second / RHO / area)  # Euler's; shear lowers it by some 1e-4
    assert result[0] == pytest.approx(bending, rel=2e-3)
