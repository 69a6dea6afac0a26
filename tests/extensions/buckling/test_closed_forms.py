"""Buckling against closed forms: plates, columns, strips; and the plate of TACS's tests.

S. G. Lekhnitskii, Anisotropic Plates (1968): simply supported orthotropic plate; S. P. Timoshenko and J. M. Gere, Theory of
Elastic Stability (1961): columns, strips; J. M. Whitney and A. W. Leissa, AIAA J. 8 (1970): antisymmetric angle plies.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import torch

import torchmbd as mbd
from tests.validation.test_vibrations import CARBON, EDGES, antisymmetric_stiffness, plate, supported


def uniaxial(a: float, b: float, D: torch.Tensor, m: int, n: int) -> float:
    """Load per length of a mode of a specially orthotropic plate compressed along x."""
    p, q = m * math.pi / a, n * math.pi / b
    return float(D[0, 0] * p**4 + 2 * (D[0, 1] + 2 * D[2, 2]) * p**2 * q**2 + D[1, 1] * q**4) / p**2


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_simply_supported_orthotropic_plate(kind):
    a, b = 1.2, 0.8
    laminate = mbd.Laminate(CARBON, [0.0, math.pi / 2, 0.0], [1e-3, 1e-3, 1e-3])
    body = plate(laminate, (a, b), (32, 22), kind)
    loads = {"right_edge": (-b, 0.0, 0.0), "left_edge": (b, 0.0, 0.0)}  # 1 N/m
    result = mbd.buckling.linear_buckling(body, loads, supported(body.mesh, True), number=3).factors
    D = laminate.stiffness().D.detach()
    expected = sorted(uniaxial(a, b, D, m, n) for m, n in product(range(1, 6), range(1, 4)))[:3]
    assert result.tolist() == pytest.approx(expected, rel=1e-2)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_antisymmetric_angle_ply_plate(kind):
    """Edges of the second kind of simple support: normal displacement free, tangential held."""
    a, b, theta = 0.6, 0.6, math.pi / 4
    laminate = mbd.Laminate(CARBON, [theta, -theta], [1e-3, 1e-3])
    body = plate(laminate, (a, b), (20, 20), kind)
    A, B, D, _ = (X.detach() for X in laminate.stiffness())

    def load(m: int, n: int) -> float:
        p, q = m * math.pi / a, n * math.pi / b
        return antisymmetric_stiffness(A, B, D, p, q) / p**2

    # the mode is u ~ sin(p x) cos(q y), v ~ cos(p x) sin(q y): u is held at edges of x, v at edges of y, where also the
    # uniform compression without forces along y is imposed
    eps = -1e-3
    free = -eps * float(A[0, 1] / A[1, 1])
    left, bottom = -0.5 * a * eps, -0.5 * b * free
    supports = {
        "left_edge": (left, None, 0.0, 0.0, None, None),
        "right_edge": (-left, None, 0.0, 0.0, None, None),
        "bottom_edge": (None, bottom, 0.0, None, 0.0, None),
        "top_edge": (None, -bottom, 0.0, None, 0.0, None),
    }
    result = (
        mbd.buckling.linear_buckling(body, {}, supports).factors.item() * float(A[0, 0] - A[0, 1] ** 2 / A[1, 1]) * -eps
    )
    expected = min(load(m, n) for m, n in product(range(1, 4), range(1, 3)))
    assert result == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize(
    ("start", "end", "factor"),
    [
        ("all", "", 0.25),
        ("u1 u2 u3 phi1", "u2 u3", 1.0),
        ("all", "u2 u3", 2.04575),
        ("all", "u2 u3 phi2 phi3", 4.0),
    ],
)
def test_euler_columns(start, end, factor):
    stiffness = torch.diag(torch.tensor([1e8, 1e8, 1e8, 1e3, 100.0, 200.0], dtype=torch.float64))
    section = mbd.GivenSection(stiffness, torch.diag(torch.tensor([1.0, 1, 1, 2, 1, 1], dtype=torch.float64)))
    body = mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(2.0, 12), section, modes=2)
    supports = {"start": start} | ({"end": end} if end else {})
    result = mbd.buckling.linear_buckling(body, {"end": (-1.0, 0.0, 0.0)}, supports).factors
    assert result[0].item() == pytest.approx(factor * math.pi**2 * 100.0 / 4.0, rel=1e-3)


def lateral(EI: float, GJ: float, EW: float, L: float) -> float:
    """Force at the tip by Ritz's method: GJ twist'^2 + EW twist''^2 = (P (L - x) twist)^2 / EI; 4.013 without EW."""
    x, w = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(40))
    x, w = 0.5 * (x + 1.0), 0.5 * w
    k = torch.arange(2.0 if EW else 1.0, 12.0, dtype=torch.float64)[:, None]
    f, d, dd = x**k, k * x ** (k - 1), k * (k - 1) * x ** (k - 2)
    stiff = (d * w) @ d.T * GJ / L + (dd * w) @ dd.T * EW / L**3
    pull = (f * w * (1.0 - x) ** 2) @ f.T * L**3 / EI
    return float(1.0 / scipy.linalg.eigh(pull.numpy(), stiff.numpy(), eigvals_only=True)[-1]) ** 0.5


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "cells"), [("quad", (40, 4)), ("triangle", (80, 8))])
def test_lateral_buckling_of_a_strip(kind, cells):
    """A cantilever strip under a force at its tip, in its plane; its clamped end keeps plane, which is worth 2 %."""
    E, nu, L, h, t = 70e9, 0.3, 1.0, 0.05, 0.0005
    ply = mbd.Ply(E1=E, E2=E, G12=E / 2.6, G13=E / 2.6, G23=E / 2.6, nu12=nu, density=2700.0)
    mesh = mbd.mesh.rectangle(L, h, cells, kind)
    body = mbd.FlexibleBody.plate("strip", mesh, mbd.Laminate(ply, [0.0], [t]), modes=2, reference="left_edge")
    tip = min(mesh.node_sets["right_edge"], key=lambda k: abs(float(mesh.nodes[k, 1])))
    result = mbd.buckling.linear_buckling(body, {tip: (0.0, 1.0, 0.0)}).factors.item()
    EI, GJ, EW = E * h * t**3 / 12.0, E / 2.6 * h * t**3 / 3.0, E * h**3 * t**3 / 144.0
    assert lateral(EI, GJ, 0.0, L) == pytest.approx(4.0126 * (EI * GJ) ** 0.5, rel=1e-3)
    assert result == pytest.approx(lateral(EI, GJ, EW, L), rel=1e-2)


@pytest.mark.thorough
def test_plate_of_tacs():
    """4 x 3 m, 20 mm, E = 205 GPa, 20 kN/m along the 3 m: TACS has 20.1836, 48.9392, 82.3268 on 8 x 6 cells."""
    E = 205e9
    ply = mbd.Ply(E1=E, E2=E, G12=E / 2.6, G13=E / 2.6, G23=E / 2.6, nu12=0.3, density=2500.0)
    body = plate(mbd.Laminate(ply, [0.0], [0.02]), (4.0, 3.0), (24, 18), "quad")
    corner = body.mesh.node_set("corner_left_bottom")[0]
    supports = dict.fromkeys(EDGES, "u3 phi3") | {"bottom_edge": "u2 u3 phi3", (corner,): "all"}
    result = mbd.buckling.linear_buckling(body, {"top_edge": (0.0, -80e3, 0.0)}, supports, number=5).factors
    assert result[0].item() == pytest.approx(20.18364503, rel=1e-2)
    D = E * 0.02**3 / 12.0 / 0.91 * torch.tensor([[1.0, 0.3, 0.0], [0.3, 1.0, 0.0], [0.0, 0.0, 0.35]])
    expected = sorted(uniaxial(3.0, 4.0, D, m, n) / 20e3 for m, n in product(range(1, 5), range(1, 5)))[:5]
    assert result.tolist() == pytest.approx(expected, rel=1.2e-2)


def clamped(size: tuple[float, float], t: float, E: float, nu: float, N: list[list[float]]) -> float:
    """Factor of uniform forces N of a clamped plate with shear, by Ritz's method with 10 x 10 polynomials of w and both
    rotations, which vanish on the edges."""
    x, weight = np.polynomial.legendre.leggauss(20)
    bubble = np.polynomial.Polynomial([1.0, 0.0, -1.0])
    shape = [np.polynomial.Legendre.basis(k).convert(kind=np.polynomial.Polynomial) * bubble for k in range(10)]
    f, d = np.stack([p(x) for p in shape]), np.stack([p.deriv()(x) for p in shape])
    W = np.kron(weight, weight) * size[0] * size[1] / 4.0
    v, vx, vy = np.kron(f, f), np.kron(d, f) * 2.0 / size[0], np.kron(f, d) * 2.0 / size[1]
    o = np.zeros_like(v)
    strains = [(o, vx, o), (o, o, vy), (o, vy, vx), (vx, v, o), (vy, o, v)]  # of w and of w,x = -a, w,y = -b
    D, S = E * t**3 / 12.0 / (1.0 - nu**2), 5.0 / 6.0 * E / 2.0 / (1.0 + nu) * t
    law = np.zeros((5, 5))
    law[:2, :2], law[2, 2], law[3, 3], law[4, 4] = D * np.array([[1.0, nu], [nu, 1.0]]), D * (1.0 - nu) / 2.0, S, S
    rows = [np.concatenate(row) for row in strains]
    K = sum(law[i, j] * (rows[i] * W) @ rows[j].T for i, j in product(range(5), range(5)) if law[i, j])
    slopes = [np.concatenate([s, o, o]) for s in (vx, vy)]
    Kg = sum(N[i][j] * (slopes[i] * W) @ slopes[j].T for i, j in product(range(2), range(2)))
    return float(1.0 / scipy.linalg.eigh(-Kg, K, eigvals_only=True)[-1])


@pytest.mark.thorough
def test_clamped_plate_under_compression_and_shear():
    """1 x 0.7 m, 70 mm, strains -1e-3, 0 and 2e-3: TACS has 52.6164, 58.4871 on 5 x 5 cells, Ritz's method 41.6."""
    E, nu, t = 70e9, 0.33, 0.07
    ply = mbd.Ply(E1=E, E2=E, G12=E / 2.66, G13=E / 2.66, G23=E / 2.66, nu12=nu, density=2500.0)
    body = plate(mbd.Laminate(ply, [0.0], [t]), (1.0, 0.7), (20, 20), "quad")
    edges = {int(i) for edge in EDGES for i in body.mesh.node_sets[edge]}
    places = {i: body.mesh.nodes[i].tolist() for i in edges}
    supports = {(i,): (1e-3 * (y - x), 1e-3 * x, 0.0, 0.0, 0.0, 0.0) for i, (x, y, _) in places.items()}
    result = mbd.buckling.linear_buckling(body, {}, supports, number=2).factors
    N = (-1e-3 * E * t / (1.0 - nu**2), -1e-3 * nu * E * t / (1.0 - nu**2), 2e-3 * E * t / 2.0 / (1.0 + nu))
    expected = clamped((1.0, 0.7), t, E, nu, [[N[0], N[2]], [N[2], N[1]]])
    assert result[0].item() == pytest.approx(expected, rel=1e-2)


def transfer(factor: float, load: np.ndarray, C: np.ndarray, twist: float, steps: int = 40) -> float:
    """Zero where a clamped beam of length 1 under a force and a moment at its end has a second equilibrium nearby.

    Rates along the straight beam of (u, th, n, m): displacement, rotation, changes of force and moment in fixed axes. Sections
    of flexibility C carry the force F and the moment M + (1 - x) e x F; a moment at the end turns by half of th.
    """

    def cross(a: np.ndarray) -> np.ndarray:
        return np.cross(np.eye(3), a)

    e, F, M = np.array([1.0, 0.0, 0.0]), factor * load[:3], factor * load[3:]

    def rate(x: float, y: np.ndarray) -> np.ndarray:
        c, s = math.cos(twist * x), math.sin(twist * x)
        turn = scipy.linalg.block_diag(1.0, [[c, -s], [s, c]], 1.0, [[c, -s], [s, c]])
        _, th, n, m = y.reshape(4, 3, 6)
        inside = np.vstack([n + cross(F) @ th, m + cross(M + (1.0 - x) * np.cross(e, F)) @ th])
        strain = turn @ C @ turn.T @ inside
        du = strain[:3] - cross(e) @ th
        return np.vstack([du, strain[3:], 0.0 * n, cross(F) @ du - cross(e) @ n])

    y, h = np.vstack([np.zeros((6, 6)), np.eye(6)]), 1.0 / steps
    for k in range(steps):
        a = rate(k * h, y)
        b = rate((k + 0.5) * h, y + 0.5 * h * a)
        c = rate((k + 0.5) * h, y + 0.5 * h * b)
        d = rate((k + 1.0) * h, y + h * c)
        y = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    free = np.vstack([y[6:9], y[9:] + 0.5 * cross(M) @ y[3:6]])
    return float(np.linalg.det(free))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "load",
    [
        (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (-1.0, 0.3, 0.5, 0.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0, 0.0, 0.2),
        (0, 0, 0, 1.0, 0.4, 0),
    ],
)
def test_twisted_beams_whose_strains_are_coupled(load):
    """Bending with torsion and shear, tension with torsion; compression, forces across, bending and torsional moments."""
    K = torch.diag(torch.tensor([2e7, 5e5, 4e5, 60.0, 100.0, 400.0], dtype=torch.float64))
    for (i, j), x in {(3, 4): 35.0, (3, 5): -60.0, (4, 5): 60.0, (1, 2): 1e5, (0, 3): 2e3}.items():
        K[i, j] = K[j, i] = x
    section = mbd.GivenSection(K, torch.diag(torch.tensor([1.0, 1, 1, 8e-4, 2e-4, 6e-4])).double())
    ends = torch.linspace(0.0, 1.2, 17, dtype=torch.float64)
    line, twist = mbd.BeamLine.straight(1.0, 16), torch.stack([ends[:-1], ends[1:]], 1)
    body = mbd.FlexibleBody.beam("rod", line, section, modes=2, reference="start", twist=twist)
    result = mbd.buckling.linear_buckling(body, {"end": load}).factors.item()
    C, numbers = np.linalg.inv(K.numpy()), np.array(load, dtype=float)
    below = [transfer(x * result, numbers, C, 1.2) for x in (0.05, 0.3, 0.6, 0.9)]
    assert min(below) > 0.0
    expected = scipy.optimize.brentq(lambda x: transfer(x, numbers, C, 1.2), 0.9 * result, 1.1 * result)
    assert result == pytest.approx(expected, rel=3e-3)
