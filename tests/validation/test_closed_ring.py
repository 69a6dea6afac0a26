"""Four exact beams joined to a ring: diameters under opposite forces, bending moment and frequencies in closed form.

W. C. Young, R. G. Budynas, Roark's Formulas for Stress and Strain (2002), table 9.2: a thin ring under two opposite forces;
A. E. H. Love, A Treatise on the Mathematical Theory of Elasticity (1927), article 293: vibrations of a ring.
"""

from __future__ import annotations

import math

import pytest
import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import given, matrix

RADIUS, EI, GJ, PULL = 1.0, 10.0, 8.0, 0.05
QUARTER = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def ring(elements: int) -> tuple[list[mbd.FlexibleBeam], list[mbd.Fixed]]:
    """Quarters from the lowest point on, each joined to the next: the last joint closes the ring."""
    section = given(1e7, 1e7, 1e7, GJ, EI, EI, mass=matrix(1.0, 1.0, 1.0, 2e-4, 1e-4, 1e-4))
    line, x, A = mbd.BeamLine.arc(RADIUS, math.pi / 2.0, elements), torch.zeros(3).double(), torch.eye(3).double()
    beams = []
    for k in range(4):
        beams.append(mbd.FlexibleBeam(f"quarter{k}", line, section, (0.0, 0.0, 1.0), position=x, axes=A))
        x, A = x + A @ line.nodes[-1], A @ QUARTER
    return beams, [mbd.Fixed(a.at("end"), b.at("start")) for a, b in zip(beams, [*beams[1:], beams[0]], strict=True)]


def pulled(elements: int) -> mbd.integrate.Equilibrium:
    beams, joints = ring(elements)
    wall = mbd.Fixed(mbd.Ground().at(), beams[0].at("start"), name="wall")
    return mbd.equilibrium(mbd.System(beams, [wall, *joints], [mbd.Force(beams[2].at("start"), (0.0, PULL, 0.0))]))


@pytest.mark.thorough
def test_diameters_and_moments():
    """They grow by (pi/4 - 2/pi) and fall by (2/pi - 1/2) of P R^3 / E I, extrapolated; P R / pi under the force."""
    result = []
    for elements in (3, 6):
        rest = pulled(elements)
        nodes = [rest.body(f"quarter{k}").nodes[0, 0, 0] for k in range(4)]
        result.append(torch.stack([(nodes[2] - nodes[0])[1], (nodes[1] - nodes[3])[0]]) - 2.0 * RADIUS)
    grown, fallen = ((4.0 * result[1] - result[0]) / 3.0 * EI / PULL).tolist()
    assert grown == pytest.approx(math.pi / 4.0 - 2.0 / math.pi, rel=1e-2)
    assert fallen == pytest.approx(0.5 - 2.0 / math.pi, rel=1e-2)
    assert abs(rest.body("quarter2").forces[0, 0, 0, 0, 4].item()) == pytest.approx(PULL * RADIUS / math.pi, rel=2e-3)
    assert rest.body("quarter1").forces[0, 0, 0, 0, 0].item() == pytest.approx(0.5 * PULL, rel=1e-5)
    assert rest.reaction("wall").force[0, 0].tolist() == pytest.approx([0.0, -PULL, 0.0], abs=1e-8)


@pytest.mark.thorough
def test_frequencies():
    """n (n^2 - 1) / sqrt(n^2 + 1) in the plane, n (n^2 - 1) / sqrt(n^2 + E I / G J) across, twice each; n = 2, extrapolated."""
    result = []
    for elements in (3, 6):
        beams, joints = ring(elements)
        hold = mbd.Bushing(mbd.Ground().at(), beams[0].at("start"), 1e-4, turning_stiffness=1e-4)
        system = mbd.System(beams, joints, [hold])
        result.append(2.0 * math.pi / math.sqrt(EI) * mbd.equilibrium(system).vibrations[0].frequencies[6:10])
    expected = [6.0 / math.sqrt(4.0 + EI / GJ)] * 2 + [6.0 / math.sqrt(5.0)] * 2
    assert ((4.0 * result[1] - result[0]) / 3.0).tolist() == pytest.approx(expected, rel=5e-3)
