"""Natural frequencies of supported bodies against closed forms and published numbers: plates and beams.

J. N. Reddy, Mechanics of Laminated Composite Plates and Shells, 2nd ed. (2004), section 5.2 (orthotropic, simply supported),
section 6.4 (antisymmetric angle plies); A. W. Leissa, J. Sound Vib. 31 (1973) 257-293 (square plates with all kinds of edges);
S. P. Timoshenko, Vibration Problems in Engineering (beams).
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
    result: dict[tuple[int, ...] | str, str] = dict(held)
    lowest = mesh.node_set("corner_left_bottom")[0], mesh.node_set("corner_right_bottom")[0]
    result[(lowest[0],)], result[(lowest[1],)] = "u1 u2", "u2"
    return result


def antisymmetric_stiffness(A: torch.Tensor, B: torch.Tensor, D: torch.Tensor, p: float, q: float) -> float:
    """Force per area of a deflection sin(p x) sin(q y) of an antisymmetric angle-ply plate (Whitney and Leissa)."""
    t11, t22 = A[0, 0] * p**2 + A[2, 2] * q**2, A[1, 1] * q**2 + A[2, 2] * p**2
    t12 = (A[0, 1] + A[2, 2]) * p * q
    t13, t23 = -(3 * B[0, 2] * p**2 + B[1, 2] * q**2) * q, -(B[0, 2] * p**2 + 3 * B[1, 2] * q**2) * p
    t33 = D[0, 0] * p**4 + 2 * (D[0, 1] + 2 * D[2, 2]) * p**2 * q**2 + D[1, 1] * q**4
    return float(t33 + (2 * t12 * t23 * t13 - t22 * t13**2 - t11 * t23**2) / (t11 * t22 - t12**2))


NU = 0.3
ALUMINUM = mbd.Ply.isotropic(E=70e9, nu=NU, density=2700.0)
EI, MASS, LENGTH = 100.0, 1.0, 2.0


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_simply_supported_orthotropic_plate(kind):
    a, b = 1.2, 0.8
    laminate = mbd.Laminate(CARBON, [0.0, math.pi / 2, 0.0], [1e-3, 1e-3, 1e-3])
    body = plate(laminate, (a, b), (32, 22), kind)
    result = mbd.natural_frequencies(body, supported(body.mesh, True), number=4).frequencies
    D, mass = laminate.stiffness().D.detach(), CARBON.density * 3e-3

    def frequency(m: int, n: int) -> float:
        p, q = m * math.pi / a, n * math.pi / b
        k = D[0, 0] * p**4 + 2 * (D[0, 1] + 2 * D[2, 2]) * p**2 * q**2 + D[1, 1] * q**4
        return math.sqrt(float(k) / mass) / (2 * math.pi)

    expected = sorted(frequency(m, n) for m, n in product(range(1, 6), range(1, 5)))[:4]
    assert result.tolist() == pytest.approx(expected, rel=1e-2)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_antisymmetric_angle_ply_plate(kind):
    """Edges of the second kind of simple support: normal displacement held at edges of x for u ~ sin(p x) cos(q y)."""
    a, theta = 0.6, math.pi / 4
    laminate = mbd.Laminate(CARBON, [theta, -theta], [1e-3, 1e-3])
    body = plate(laminate, (a, a), (20, 20), kind)
    edges = {
        "left_edge": "u1 u3 phi1",
        "right_edge": "u1 u3 phi1",
        "bottom_edge": "u2 u3 phi2",
        "top_edge": "u2 u3 phi2",
    }
    result = mbd.natural_frequencies(body, edges, number=3).frequencies
    A, B, D, _ = (X.detach() for X in laminate.stiffness())

    def frequency(m: int, n: int) -> float:
        p, q = m * math.pi / a, n * math.pi / a
        k = antisymmetric_stiffness(A, B, D, p, q)
        return math.sqrt(k / (CARBON.density * 2e-3)) / (2 * math.pi)

    expected = sorted(frequency(m, n) for m, n in product(range(1, 4), range(1, 4)))[:3]
    assert result.tolist() == pytest.approx(expected, rel=1e-2)


SQUARE = {  # edges that are clamped, numbers omega a^2 (rho h / D)^1/2 of Leissa, table C and others of 1973
    "clamped": (EDGES, [35.992, 73.413, 73.413, 108.27, 131.64, 132.24]),
    "cantilever": (EDGES[:1], [3.4917, 8.5246, 21.429, 27.331, 31.111, 54.443]),
    "free": ((), [13.489, 19.789, 24.432, 35.024, 35.024, 61.526]),
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
@pytest.mark.parametrize("name", SQUARE)
def test_square_plates_of_leissa(kind, name):
    edges, numbers = SQUARE[name]
    a, h = 1.0, 2e-3
    mesh = mbd.mesh.rectangle(a, a, (28, 28), kind)
    mass = "lumped" if edges else "consistent"  # lumped masses at free edges have larger errors, of second order
    body = mbd.FlexibleBody.plate("plate", mesh, mbd.Laminate(ALUMINUM, [0.0], [h]), modes=2, mass=mass)
    result = mbd.natural_frequencies(body, dict.fromkeys(edges, "all"), number=6).frequencies
    D = 70e9 * h**3 / (12 * (1 - NU**2))
    scaled = 2 * math.pi * result.detach() * a**2 * math.sqrt(2700.0 * h / D)
    assert scaled.tolist() == pytest.approx(numbers, rel=1e-2)


def rod(elements: int) -> mbd.FlexibleBody:
    stiffness = torch.diag(torch.tensor([1e8, 1e8, 1e8, 1e3, EI, 2.0 * EI], dtype=torch.float64))
    inertia = torch.diag(torch.tensor([MASS, MASS, MASS, 2e-6, 1e-6, 1e-6], dtype=torch.float64))
    section = mbd.GivenSection(stiffness, inertia)
    return mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(LENGTH, elements), section, modes=2)


@pytest.mark.parametrize(
    ("supports", "roots"),
    [
        ({"start": "u1 u2 u3 phi1", "end": "u2 u3"}, [math.pi, 2 * math.pi]),
        ({"start": "all"}, [1.875104, 4.694091]),
        ({"start": "all", "end": "u2 u3"}, [3.926602, 7.068583]),
        ({"start": "all", "end": "all"}, [4.730041, 7.853205]),
        ({}, [4.730041, 7.853205]),
    ],
)
def test_beams(supports, roots):
    """Both planes of bending, one stiffer by 2: the limit of meshes, whose errors are of second order."""
    coarse, fine = (mbd.natural_frequencies(rod(n), supports, number=4).frequencies for n in (20, 40))
    result = (4.0 * fine - coarse) / 3.0
    base = [x**2 * math.sqrt(EI / MASS) / (2 * math.pi * LENGTH**2) for x in roots]
    assert result.tolist() == pytest.approx(sorted([*base, *(math.sqrt(2) * f for f in base)]), rel=2e-4)
