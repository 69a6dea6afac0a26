"""Beams along arcs: the circle, tip flexibility beside integrated equations and closed forms, forces, mass, bad input."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.beam_cases import coupled_section
from tests.fem.elements.plate_cases import rotation
from tests.refused import refused
from torchmbd.fem.elements import Assembly, BeamLine, Beams, GivenSection
from torchmbd.fem.elements.beam_curve import Curves

ROUND = GivenSection.isotropic(70e9, 0.3, 2700.0, 4e-4, 1.4e-8, 1.1e-8, 2e-8, 0.85, 0.8)


def turned(line, R):
    return BeamLine(line.nodes @ R.T, line.elements, line.node_sets, line.middles @ R.T)


def tip_compliance(beams, line):
    K = Assembly(line, {"b": beams}, held=[0]).stiffness().dense().detach()
    return torch.linalg.inv(K)[-6:, -6:]


def integrated(K, radius, angle, R, orientation):
    """Tip compliance of the arc: strains under the tip's forces, and the displacements that they add up to."""
    S = np.linalg.inv(K.numpy())

    def place(s):
        a = s / radius
        return R @ (radius * np.array([np.sin(a), 1 - np.cos(a), 0.0])), R @ np.array([np.cos(a), np.sin(a), 0.0])

    tip = place(radius * angle)[0]

    def rate(s, state):
        x, e = place(s)
        y = orientation - (orientation @ e) * e
        y = y / np.linalg.norm(y)
        turn = np.kron(np.eye(2), np.stack([e, y, np.cross(e, y)]))
        u = state.reshape(6, 6)
        loads = np.eye(6)
        loads[3:] += np.cross(tip - x, loads[:3].T).T
        strain = turn.T @ S @ turn @ loads
        strain[:3] += np.cross(u[3:].T, e).T
        return strain.ravel()

    result = solve_ivp(rate, (0.0, radius * angle), np.zeros(36), "DOP853", rtol=1e-11, atol=1e-18)
    return torch.from_numpy(result.y[:, -1].reshape(6, 6))


@pytest.mark.parametrize(("elements", "angle"), [(1, 1.5), (2, 3.0), (5, 5.5)])
@pytest.mark.parametrize("orientation", [(0.0, 0.0, 1.0), (0.3, -0.2, 1.0)])
def test_a_coupled_arc_is_exact(elements, angle, orientation):
    """Full 6 x 6, the plane of the arc turned in space, the section's axes along its normal or askew."""
    R, section, radius = rotation(3), coupled_section(), 0.7
    line = turned(BeamLine.arc(radius, angle, elements), R)
    across = R @ torch.tensor(orientation, dtype=torch.float64)
    result = tip_compliance(Beams(line, section, across), line)
    exact = integrated(section.stiffness().detach(), radius, angle, R.numpy(), across.numpy())
    d = exact.diagonal().rsqrt()
    assert float(((result - exact) * d[:, None] * d).abs().max()) < 1e-8


@pytest.mark.parametrize("elements", [1, 3])
def test_a_quarter_ring(elements):
    """Castigliano: forces at the end along the radius and out of the plane, M = P r sin, T = P r (1 - cos)."""
    r, P = 0.5, 1.0
    EA, GAy, GAz, GJ, EIy, EIz = ROUND.stiffness().diagonal().tolist()
    line = BeamLine.arc(r, np.pi / 2, elements)
    result = tip_compliance(Beams(line, ROUND, (0.0, 0.0, 1.0)), line)
    # The section's y points out of the plane: bending in the plane is about it. At the end the radius lies along x.
    inside = np.pi / 4 * P * r * (r**2 / EIy + 1 / EA + 1 / GAz)
    outside = P * r**3 * (np.pi / 4 / EIz + (3 * np.pi / 4 - 2) / GJ) + P * r * np.pi / 2 / GAy
    assert float(result[0, 0]) == pytest.approx(inside, rel=1e-9)
    assert float(result[2, 2]) == pytest.approx(outside, rel=1e-9)


def test_places_and_tangents_lie_on_the_circle():
    line = BeamLine.arc(2.0, 4.0, 3)
    start, end = line.nodes[line.elements].unbind(1)
    curves = Curves.through(start, end, line.middles)
    assert_close(curves.length, torch.full((3,), 8.0 / 3, dtype=torch.float64))
    t = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
    place, tangent = curves.at(t)
    at = 4.0 / 3 * (torch.arange(3)[:, None] + t)
    assert_close(place, torch.stack([2 * at.sin(), 2 - 2 * at.cos(), 0 * at], -1))
    assert_close(tangent, torch.stack([at.cos(), at.sin(), 0 * at], -1), rtol=0, atol=1e-12)


def test_flat_arcs_are_straight():
    """A beam with its middles on its chords is the straight one, one with hardly any arrow is nearly so."""
    line = BeamLine.straight(0.9, 3)
    halves = 0.5 * (line.nodes[1:] + line.nodes[:-1])
    straight = Beams(line, ROUND).values()
    for arrow, error in ((0.0, 1e-12), (1e-7, 1e-5)):
        bent = halves + torch.tensor([0.0, 0.0, arrow], dtype=torch.float64)
        result = Beams(BeamLine(line.nodes, middles=bent), ROUND).values()
        assert_close(result, straight, rtol=error, atol=error * float(straight.abs().max()))


def test_rigid_motions_and_forces():
    """A free arc has six rigid motions; a loaded one carries at every node what equilibrium says, in its axes there."""
    line = turned(BeamLine.arc(0.7, 2.0, 2), rotation(5))
    beams = Beams(line, coupled_section(), rotation(5)[:, 2])
    K = Assembly(line, {"b": beams}).stiffness().dense().detach()
    d = K.diagonal().rsqrt()
    values = torch.linalg.eigvalsh(K * d * d[:, None])
    assert float(values[:6].abs().max()) < 1e-12
    assert float(values[6]) > 1e-6
    load = torch.tensor([10.0, -20.0, 30.0, 1.0, 2.0, -3.0], dtype=torch.float64)
    u = torch.linalg.solve(K[6:, 6:], torch.cat([torch.zeros(6, dtype=torch.float64), load]))
    motion = torch.cat([torch.zeros(6, dtype=torch.float64), u]).reshape(3, 6, 1)
    result = beams.section_forces(motion)[..., 0].detach()
    frames = beams.matrices.frames(torch.tensor([0.0, 1.0], dtype=torch.float64))
    for element in range(2):
        for end in range(2):
            arm = line.nodes[2] - line.nodes[element + end]
            moment = load[3:] + torch.linalg.cross(arm, load[:3])
            axes = frames[element, end]
            assert_close(result[element, end], torch.cat([axes @ load[:3], axes @ moment]), rtol=0, atol=1e-7)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_mass_and_first_frequency(mass):
    """Mass along the arc; the clamped half ring has the frequency of a polygon of ten times as many elements."""
    body = mbd.FlexibleBody.beam(
        "ring", BeamLine.arc(0.5, np.pi, 12), ROUND, 2, reference="start", orientation=(0.0, 0.0, 1.0), mass=mass
    )
    result = body.structure()
    assert float(result["mass"]) == pytest.approx(2700.0 * 4e-4 * np.pi * 0.5, rel=1e-12)
    nodes = BeamLine.arc(0.5, np.pi, 120).nodes
    fine = mbd.FlexibleBody.beam("ring", BeamLine(nodes), ROUND, 2, reference="start", orientation=(0.0, 0.0, 1.0))
    one, two = (torch.linalg.eigvalsh(x["Kr"].detach())[0] for x in (result, fine.structure()))
    assert float((one / two).sqrt()) == pytest.approx(1.0, abs=0.01)


def test_bad_arcs_are_named():
    for make, path in (
        (lambda: BeamLine.arc(0.0, 1.0), "radius"),
        (lambda: BeamLine.arc(1.0, 7.0), "angle"),
        (lambda: BeamLine.arc(1.0, 4.0, 1), "elements"),
        (lambda: BeamLine([[0, 0, 0], [1, 0, 0]], middles=[[0.4, 0.1, 0.0]]), "middles.0"),
        (lambda: BeamLine([[0, 0, 0], [1, 0, 0]], middles=[[0.5, 0.7, 0.0]]), "middles.0"),
        (lambda: BeamLine([[0, 0, 0], [1, 0, 0]], middles=[[0.5, 0.7]]), "middles"),
    ):
        with refused(path):
            make()
