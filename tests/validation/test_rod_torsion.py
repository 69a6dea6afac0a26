"""Torsion of the paper's rod at 0 degrees by equal torques at its ends: the shipped mesh beside Saint-Venant's rate of twist.

    1 / G J,    J = b h^3 / 3 (1 - 192 h / (pi^5 b) sum over odd n of tanh(n pi b / 2 h) / n^5)        G12 = G13

Source: S. P. Timoshenko and J. N. Goodier, Theory of Elasticity, chapter 10.
"""

import math

import numpy as np
import pytest

import torchmbd as mbd
from tests.fem.elements.plate_cases import freedoms, solved, stiffness
from torchmbd.examples.slider_crank import CARBON, DEPTH, ROD, THICKNESS, build
from torchmbd.fem.elements import PlateMatrices

SERIES = sum(math.tanh(n * math.pi * DEPTH / (2 * THICKNESS)) / n**5 for n in range(1, 60, 2))
J = DEPTH * THICKNESS**3 / 3 * (1 - 192 * THICKNESS / (math.pi**5 * DEPTH) * SERIES)


def twist(mesh: mbd.Mesh) -> float:
    """Rate of twist of the middle half under 1 N m, over the exact one."""
    laminate = mbd.Laminate(mbd.Ply(**CARBON), [0.0], THICKNESS)
    plate, load = PlateMatrices(mesh, laminate), np.zeros(6 * len(mesh.nodes))
    x, y = mesh.nodes[:, 0].numpy(), mesh.nodes[:, 1].numpy()
    for name, sign in (("right_edge", 1.0), ("left_edge", -1.0)):
        edge = np.array(mesh.node_set(name))
        weight = np.where(np.abs(y[edge]) > DEPTH / 2 - 1e-9, 0.5, 1.0) * y[edge]
        load[6 * edge + 2] = sign * weight / (weight @ y[edge])
    u = solved(stiffness(plate, laminate), load, freedoms([mesh.node("center")]))

    def angle(place: float) -> float:
        across = np.flatnonzero(np.abs(x - place) < 1e-9)
        return u[6 * across + 2] @ y[across] / (y[across] @ y[across])

    return (angle(ROD / 4) - angle(-ROD / 4)) / (ROD / 2) * CARBON["G12"] * J


@pytest.mark.thorough
def test_the_shipped_rod():
    """4 % too stiff with 24 x 4 quadrilaterals; 8 % with triangles."""
    assert twist(build(1, [0.0]).body("rod").mesh) == pytest.approx(0.965, abs=2e-3)  # pyright: ignore
    assert twist(build(1, [0.0], kind="triangle").body("rod").mesh) == pytest.approx(0.923, abs=2e-3)  # pyright: ignore


@pytest.mark.thorough
@pytest.mark.parametrize("cells", [(12, 2), (24, 4), (48, 8)])
def test_quadrilaterals_are_nearer_at_every_mesh(cells):
    result = {kind: 1.0 - twist(mbd.mesh.rectangle(ROD, DEPTH, cells, kind)) for kind in ("quad", "triangle")}
    assert 0.0 < result["quad"] < 0.8 * result["triangle"]


@pytest.mark.thorough
def test_the_limit_is_that_of_the_theory():
    assert twist(mbd.mesh.rectangle(ROD, DEPTH, (192, 32))) == pytest.approx(1.0, abs=3e-3)
