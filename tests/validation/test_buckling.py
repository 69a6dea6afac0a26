"""Buckling against closed forms: plates, columns, strips; and the plate of TACS's tests.

S. G. Lekhnitskii, Anisotropic Plates (1968): simply supported orthotropic plate; S. P. Timoshenko and J. M. Gere, Theory of
Elastic Stability (1961): columns, strips; J. M. Whitney and A. W. Leissa, AIAA J. 8 (1970): antisymmetric angle plies.
"""

from __future__ import annotations

import math
from itertools import product

import pytest
import torch

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
EDGES = ("left_edge", "right_edge", "bottom_edge", "top_edge")


def plate(laminate: mbd.Laminate, size: tuple[float, float], cells: tuple[int, int], kind: str) -> mbd.FlexibleBody:
    return mbd.FlexibleBody.plate("plate", mbd.mesh.rectangle(*size, cells, kind), laminate, modes=2)


def supported(mesh: mbd.Mesh, tangents: bool) -> dict:
    """Simple supports, in the plane as statics asks; tangents: rotations about the normals of the edges are held, too."""
    held: dict = {
        edge: "u3 phi3"
        + (("" if not tangents else " phi1") if edge in EDGES[:2] else ("" if not tangents else " phi2"))
        for edge in EDGES
    }
    found: dict[tuple[int, ...] | str, str] = dict(held)
    lowest = mesh.node_set("corner_left_bottom")[0], mesh.node_set("corner_right_bottom")[0]
    found[(lowest[0],)], found[(lowest[1],)] = "u1 u2", "u2"
    return found


def uniaxial(a: float, b: float, D: torch.Tensor, m: int, n: int) -> float:
    """Load per length of a mode of a specially orthotropic plate compressed along x."""
    p, q = m * math.pi / a, n * math.pi / b
    return float(D[0, 0] * p**4 + 2 * (D[0, 1] + 2 * D[2, 2]) * p**2 * q**2 + D[1, 1] * q**4) / p**2


@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_simply_supported_orthotropic_plate(kind):
    a, b = 1.2, 0.8
    laminate = mbd.Laminate(CARBON, [0.0, math.pi / 2, 0.0], [1e-3, 1e-3, 1e-3])
    body = plate(laminate, (a, b), (24, 16), kind)
    loads = {"right_edge": (-b, 0.0, 0.0), "left_edge": (b, 0.0, 0.0)}  # 1 N/m
    found = mbd.buckling(body, loads, supported(body.mesh, True), number=3).factors
    D = laminate.stiffness().D.detach()
    wanted = sorted(uniaxial(a, b, D, m, n) for m, n in product(range(1, 6), range(1, 4)))[:3]
    assert found.tolist() == pytest.approx(wanted, rel=1e-2)


@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_antisymmetric_angle_ply_plate(kind):
    """Edges of the second kind of simple support: normal displacement free, tangential held."""
    a, b, theta = 0.6, 0.6, math.pi / 4
    laminate = mbd.Laminate(CARBON, [theta, -theta], [1e-3, 1e-3])
    body = plate(laminate, (a, b), (20, 20), kind)
    A, B, D, _ = (X.detach() for X in laminate.stiffness())

    def load(m: int, n: int) -> float:
        p, q = m * math.pi / a, n * math.pi / b
        t11, t22 = A[0, 0] * p**2 + A[2, 2] * q**2, A[1, 1] * q**2 + A[2, 2] * p**2
        t12 = (A[0, 1] + A[2, 2]) * p * q
        t13, t23 = -(3 * B[0, 2] * p**2 + B[1, 2] * q**2) * q, -(B[0, 2] * p**2 + 3 * B[1, 2] * q**2) * p
        t33 = D[0, 0] * p**4 + 2 * (D[0, 1] + 2 * D[2, 2]) * p**2 * q**2 + D[1, 1] * q**4
        coupled = (2 * t12 * t23 * t13 - t22 * t13**2 - t11 * t23**2) / (t11 * t22 - t12**2)
        return float(t33 + coupled) / p**2

    # w = sin sin is met by u ~ sin(p x) cos(q y), v ~ cos(p x) sin(q y): u vanishes at x = 0, v at y = 0
    supports = {edge: ("u1 u3 phi1 phi3" if edge in EDGES[:2] else "u2 u3 phi2 phi3") for edge in EDGES}
    middle = body.mesh.node_set("center")[0]
    wanted = min(load(m, n) for m, n in product(range(1, 4), range(1, 3)))
    shift = 1e-4
    supports = {
        "left_edge": (shift, None, 0.0, 0.0, None, 0.0),
        "right_edge": (-shift, None, 0.0, 0.0, None, 0.0),
        "bottom_edge": (None, None, 0.0, None, 0.0, 0.0),
        "top_edge": (None, None, 0.0, None, 0.0, 0.0),
        (middle,): (None, 0.0, None, None, None, None),
    }
    case = mbd.buckling(body, {}, supports)
    # mean force per length of the imposed shortening, with free sides: A11 - A12^2 / A22
    force = float(A[0, 0] - A[0, 1] ** 2 / A[1, 1]) * 2 * shift / a
    assert float(case.factors[0]) * force == pytest.approx(wanted, rel=5e-2)


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
    body = mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(2.0, 8), section, modes=2)
    supports = {"start": start} | ({"end": end} if end else {})
    found = mbd.buckling(body, {"end": (-1.0, 0.0, 0.0)}, supports).factors
    assert float(found[0]) == pytest.approx(factor * math.pi**2 * 100.0 / 4.0, rel=1e-3)


@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_lateral_buckling_of_a_strip(kind):
    """A cantilever strip under a force at its tip, in its plane: 4.013 (EI GJ)^1/2 / L^2."""
    E, nu, L, h, t = 70e9, 0.3, 1.0, 0.05, 0.002
    ply = mbd.Ply(E1=E, E2=E, G12=E / 2.6, G13=E / 2.6, G23=E / 2.6, nu12=nu, density=2700.0)
    mesh = mbd.mesh.rectangle(L, h, (40, 4), kind)
    body = mbd.FlexibleBody.plate("strip", mesh, mbd.Laminate(ply, [0.0], [t]), modes=2, reference="left_edge")
    tip = min(mesh.node_sets["right_edge"], key=lambda k: abs(float(mesh.nodes[k, 1])))
    found = float(mbd.buckling(body, {tip: (0.0, 1.0, 0.0)}).factors[0])
    EI, GJ = E * h * t**3 / 12.0, E / 2.6 * h * t**3 / 3.0 * (1.0 - 0.63 * t / h)
    assert found == pytest.approx(4.0126 * math.sqrt(EI * GJ) / L**2, rel=1e-2)


def test_plate_of_tacs():
    """4 x 3 m, 20 mm, E = 205 GPa, 20 kN/m along the 3 m: TACS has 20.1836 on 8 x 6 cells, the closed form 20.11."""
    E = 205e9
    ply = mbd.Ply(E1=E, E2=E, G12=E / 2.6, G13=E / 2.6, G23=E / 2.6, nu12=0.3, density=2500.0)
    body = plate(mbd.Laminate(ply, [0.0], [0.02]), (4.0, 3.0), (24, 18), "quad")
    corner = body.mesh.node_set("corner_left_bottom")[0]
    supports = dict.fromkeys(EDGES, "u3 phi3") | {"bottom_edge": "u2 u3 phi3", (corner,): "all"}
    found = mbd.buckling(body, {"top_edge": (0.0, -80e3, 0.0)}, supports, number=5).factors
    assert float(found[0]) == pytest.approx(20.18364503, rel=1e-2)
    D = E * 0.02**3 / 12.0 / 0.91 * torch.tensor([[1.0, 0.3, 0.0], [0.3, 1.0, 0.0], [0.0, 0.0, 0.35]])
    wanted = sorted(uniaxial(3.0, 4.0, D, m, n) / 20e3 for m, n in product(range(1, 5), range(1, 5)))[:5]
    assert found.tolist() == pytest.approx(wanted, rel=1.2e-2)
