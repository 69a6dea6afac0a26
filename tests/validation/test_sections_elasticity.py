"""Sections against exact solutions: torsion and flexure of isotropic bars, wide laminates, composite bars.

S. P. Timoshenko and J. N. Goodier, Theory of Elasticity, 3rd ed., articles 104-125: torsion of the rectangle (series)
and the circle, Saint-Venant's flexure of the circle. R. M. Jones, Mechanics of Composite Materials, chapter 4.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import spsolve

import torchmbd as mbd
from torchmbd.fem import sections
from torchmbd.fem.sections import Orthotropic

STEEL = Orthotropic.isotropic(E=210e9, nu=0.3, density=7850.0)
G = 210e9 / 2.6


def torsion_of_a_rectangle(a: float, b: float) -> float:
    """J of sides a >= b by the series, with 40 terms."""
    odd = np.arange(1, 80, 2)
    return a * b**3 / 3 * (1 - 192 / math.pi**5 * b / a * float(np.sum(np.tanh(odd * math.pi * a / 2 / b) / odd**5)))


@pytest.mark.parametrize("ratio", [1.0, 2.5, 10.0])
def test_rectangle(ratio):
    a, b = 0.02 * ratio, 0.02
    K = sections.rectangle(a, b, STEEL, cells=(int(10 * ratio**0.6), 10)).stiffness().detach()
    assert float(K[0, 0]) == pytest.approx(210e9 * a * b, rel=1e-10)
    assert float(K[4, 4]) == pytest.approx(210e9 * a * b**3 / 12, rel=1e-9)
    assert float(K[5, 5]) == pytest.approx(210e9 * b * a**3 / 12, rel=1e-9)
    assert float(K[3, 3]) == pytest.approx(G * torsion_of_a_rectangle(a, b), rel=1e-4)


def test_shear_of_a_rectangle_without_lateral_contraction():
    """nu = 0: the parabola of elementary beam theory is exact, and so is 5/6; quadratic elements: fourth order."""
    solid, errors = Orthotropic.isotropic(100e9, 0.0, 1.0), []
    for n in (2, 4, 8):
        K = sections.rectangle(0.03, 0.05, solid, cells=(n, n)).stiffness().detach()
        errors.append(K.diagonal()[1:3] / (50e9 * 0.03 * 0.05) - 5 / 6)
    assert float(errors[-1].abs().max()) < 5e-5
    for coarse, fine in pairwise(errors):
        assert torch.log2(coarse / fine).tolist() == pytest.approx([4.0, 4.0], abs=0.1)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_circle(nu):
    """Torsion, and shear by the energy of Saint-Venant's flexure, integrated by quadrature."""
    R, E = 0.04, 70e9
    solid = Orthotropic.isotropic(E, nu, 2700.0)
    K = sections.circle(R, solid, cells=(10, 6)).stiffness().detach()
    shear, inertia = E / 2 / (1 + nu), math.pi * R**4 / 4
    r, w = np.polynomial.legendre.leggauss(30)
    r, w = R * (r + 1) / 2, R * w / 2
    phi = np.linspace(0, 2 * math.pi, 65)[:-1]
    y, z = np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi))
    along = (3 + 2 * nu) / (8 * (1 + nu)) * (R**2 - y**2 - (1 - 2 * nu) / (3 + 2 * nu) * z**2)
    across = -(1 + 2 * nu) / (4 * (1 + nu)) * y * z
    compliance = float(((along**2 + across**2).mean(1) * 2 * math.pi * r * w).sum()) / shear / inertia**2
    assert float(K[3, 3]) == pytest.approx(shear * 2 * inertia, rel=1e-5)
    assert float(K[1, 1]) == pytest.approx(1 / compliance, rel=1e-5)
    assert float(K[2, 2]) == pytest.approx(1 / compliance, rel=1e-5)
    assert float(K[4, 4]) == pytest.approx(E * inertia, rel=1e-5)


def test_stresses_of_a_circle():
    """Torsion, bending and Saint-Venant's flexure, point by point."""
    R, nu = 0.04, 0.3
    result = sections.circle(R, STEEL, cells=(8, 6))
    inertia = math.pi * R**4 / 4
    recovered = result.stress([0.0, 5e3, 0.0, 700.0, 300.0, 0.0])
    y, z = recovered.points.unbind(-1)
    along = (3 + 2 * nu) / (8 * (1 + nu)) * (R**2 - y**2 - (1 - 2 * nu) / (3 + 2 * nu) * z**2)
    across = -(1 + 2 * nu) / (4 * (1 + nu)) * y * z
    stress = recovered.stress.detach()
    scale = float(stress.abs().max())
    exact = {
        0: 300.0 * z / inertia,
        4: 700.0 * y / (2 * inertia) + 5e3 * across / inertia,
        5: -700.0 * z / (2 * inertia) + 5e3 * along / inertia,
    }
    for component in range(6):
        expected = exact.get(component, torch.zeros_like(y))
        assert float((stress[..., component] - expected).abs().max()) < 2e-3 * scale


@pytest.mark.parametrize("angles", [[30.0], [20.0, -50.0, 75.0], [0.0, 45.0]])
def test_wide_strip_is_a_laminated_plate(angles):
    """Unbalanced and unsymmetric stacks, b/h = 200: the beam's compliance is the laminate's abd, with its signs."""
    width, height = 0.2, 1e-3
    ply = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    result = sections.strip(width, ply, mbd.deg(angles), height / len(angles), cells=(60, 2))
    S = result.compliance().detach() * width
    law = mbd.Laminate(ply, mbd.deg(angles), height / len(angles)).stiffness()
    abd = torch.linalg.inv(torch.cat([torch.cat([law.A, law.B], 1), torch.cat([law.B, law.D], 1)], 0)).detach()
    # eps = eps_xx, kappa_y = kappa_xx, kappa_x = -kappa_xy / 2; N = N_x b, M_y = M_x b, T = -2 M_xy b
    beam = {(0, 0): abd[0, 0], (4, 4): abd[3, 3], (3, 3): abd[5, 5] / 4}
    beam |= {(0, 4): abd[0, 3], (0, 3): -abd[0, 5] / 2, (3, 4): -abd[3, 5] / 2}
    for (i, j), expected in beam.items():
        scale = float((S[i, i] * S[j, j]).sqrt())
        assert float(S[i, j]) == pytest.approx(float(expected), abs=0.006 * scale), (i, j)


def test_bars_of_two_materials_share_the_load():
    """nu equal, so that no stress acts between them: EA and EI are sums, the tension center their mean."""
    stiff, soft = Orthotropic.isotropic(200e9, 0.3, 8000.0), Orthotropic.isotropic(50e9, 0.3, 2000.0)
    result = sections.strip(0.03, (soft, stiff), (0.0, 0.0), (0.01, 0.03), cells=(4, 2))
    K = result.stiffness().detach()
    EA, center = 0.03 * (0.01 * 50e9 + 0.03 * 200e9), 0.03 * (0.01 * 50e9 * -0.015 + 0.03 * 200e9 * 0.005)
    assert float(K[0, 0]) == pytest.approx(EA, rel=1e-9)
    assert float(K[0, 4]) == pytest.approx(center, rel=1e-9)
    assert result.tension_center().tolist() == pytest.approx([0.0, center / EA], abs=1e-12)
    M = result.mass()
    assert float(M[0, 0]) == pytest.approx(0.03 * (0.01 * 2000 + 0.03 * 8000), rel=1e-12)
    assert float(M[0, 4]) == pytest.approx(0.03 * (0.01 * 2000 * -0.015 + 0.03 * 8000 * 0.005), rel=1e-12)


def test_thin_box_twists_by_bredts_formula():
    """The corners add what half a thickness of each is worth: the excess falls with the wall."""
    width, height, excess = 0.2, 0.1, []
    for t in (2e-3, 1e-3, 5e-4):
        K = sections.box(width, height, STEEL, (0.0,), t, cells=(60, 40, 1)).stiffness().detach()
        w, h = width - t, height - t
        excess.append(float(K[3, 3]) / (G * 4 * (w * h) ** 2 / (2 * (w + h) / t)) - 1)
    assert 0 < excess[-1] < 2e-3
    assert np.log2(np.divide(excess[:-1], excess[1:])) == pytest.approx([1.0, 1.0], abs=0.1)


@pytest.mark.thorough
def test_i_section():
    width, height, t = 0.06, 0.1, 4e-3
    walls: dict[str, tuple[float]] = dict.fromkeys(("top", "web", "bottom"), (0.0,))
    K = sections.i_section(width, height, STEEL, walls, t, cells=(20, 40, 4)).stiffness().detach()
    clear = height - 2 * t
    assert float(K[0, 0]) == pytest.approx(210e9 * t * (2 * width + clear), rel=1e-9)
    assert float(K[4, 4]) == pytest.approx(210e9 * (width * height**3 - (width - t) * clear**3) / 12, rel=1e-9)
    assert float(K[5, 5]) == pytest.approx(210e9 * (2 * t * width**3 + clear * t**3) / 12, rel=1e-9)
    assert float(K[3, 3]) == pytest.approx(G * _prandtl(width, height, t, 24), rel=0.005)


def _prandtl(width: float, height: float, t: float, fine: int) -> float:
    """J of an I by Prandtl's stress function and finite differences of spacing t / fine (slope -2, zero at the rim)."""
    h = t / fine
    y, z = np.meshgrid(np.arange(-width / 2, width / 2 + h / 2, h), np.arange(-height / 2, height / 2 + h / 2, h))
    flange = (np.abs(y) < width / 2 - h / 2) & (np.abs(z) < height / 2 - h / 2) & (np.abs(z) > height / 2 - t + h / 2)
    inside = flange | ((np.abs(y) < t / 2 - h / 2) & (np.abs(z) < height / 2 - h / 2))
    number = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    rows, cols = [], []
    for axis in (0, 1):
        first, second = (np.take(number, np.arange(number.shape[axis])[s], axis) for s in (slice(-1), slice(1, None)))
        both = (first >= 0) & (second >= 0)
        rows += [first[both], second[both]]
        cols += [second[both], first[both]]
    n = int(inside.sum())
    row, col = np.concatenate(rows), np.concatenate(cols)
    laplace = coo_array((-np.ones(len(row)), (row, col)), shape=(n, n)) + 4 * eye_array(n)
    return float(2 * h**2 * spsolve(laplace.tocsc(), np.full(n, 2 * h**2)).sum())
