"""Flexible bodies made of beams: design parameters, invariants, motion, gradients through a motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.func import functional_call, jacfwd
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.beam_cases import coupled_section
from tests.fem.sections.section_cases import ANBA
from tests.mechanisms import finished, turned
from tests.refused import refused
from torchmbd.fem import sections
from torchmbd.fem.elements import BeamLine, GivenSection

STRIP = {"width": 0.03, "ply": ANBA, "thickness": 1e-3, "cells": (6, 1)}


def strip(*degrees: float) -> sections.Section:
    result = sections.strip(angles=mbd.deg(list(degrees)), **STRIP)
    result._constant[:, -1] = 1600.0
    return result


@pytest.mark.thorough
def test_angles_of_the_section_are_the_parameters():
    body = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.6, 8), strip(20.0, -50.0), modes=3, reference="start")
    assert [name for name, x in body.named_parameters() if x.requires_grad] == ["section.angles"]
    one, two = strip(20.0), strip(70.0)
    tapered = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.6, 4), [one, one, two, one], modes=3, reference="start")
    assert [name for name, _ in tapered.named_parameters()] == ["section0.angles", "section1.angles"]
    with refused("arm.section"):
        mbd.FlexibleBody.beam("arm", BeamLine.straight(0.6, 4), [one, two])
    with refused("arm.line"):
        mbd.FlexibleBody.beam("arm", mbd.mesh.rectangle(1.0, 0.1, (2, 1)), one)  # pyright: ignore[reportArgumentType]
    with refused("section", "steel"):
        mbd.FlexibleBody.beam("arm", BeamLine.straight(0.6, 4), "steel")  # pyright: ignore[reportArgumentType]


@pytest.mark.thorough
@pytest.mark.parametrize(("asked", "kept"), [(1, 4), (2, 4), (3, 4), (4, 4), (5, 8), (9, 12)])
def test_equal_frequencies_are_kept_together(asked, kept):
    """A square tube held at its center: four ends that bend alike, then pairs."""
    ply = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    tube = mbd.sections.box(0.02, 0.02, ply, mbd.deg([45, -45]), thickness=1e-3)
    body = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.3, 8), tube, modes=asked)
    assert body.modes == kept
    Kr = body.structure()["Kr"]
    assert Kr.shape == (kept, kept)
    more = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.3, 8), tube, modes=14).structure()["Kr"]
    squares = torch.linalg.eigvalsh(more.detach())
    assert squares[kept] > (1.0 + 1e-6) * squares[kept - 1]  # the next is another one
    assert_close(torch.linalg.eigvalsh(Kr.detach()), squares[:kept], rtol=1e-9, atol=0.0)


@pytest.mark.thorough
def test_invariants_are_those_of_the_solid():
    """A straight coupled beam off its line: mass, center and moments of inertia about the reference node."""
    section, length, n = coupled_section(), 0.9, 200
    body = mbd.FlexibleBody.beam("arm", BeamLine.straight(length, n), section, modes=2, reference="start")
    result = {key: x.detach() for key, x in body.structure().items()}
    M = section.mass()
    mass, y, z = (float(x) for x in (M[0, 0], -M[0, 5] / M[0, 0], M[0, 4] / M[0, 0]))
    assert float(result["mass"]) == pytest.approx(mass * length, rel=1e-12)
    assert result["S0"].tolist() == pytest.approx(
        [mass * length**2 / 2, mass * length * y, mass * length * z], rel=1e-12
    )
    P = torch.zeros(3, 3, dtype=torch.float64)
    P[0, 0] = mass * length**3 / 3
    P[0, 1] = P[1, 0] = mass * y * length**2 / 2
    P[0, 2] = P[2, 0] = mass * z * length**2 / 2
    P[1, 1], P[2, 2], P[1, 2] = M[5, 5] * length, M[4, 4] * length, -M[4, 5] * length
    P[2, 1] = P[1, 2]
    assert_close(result["P0"], P, rtol=1e-4, atol=1e-9)
    assert float(result["mu"]) == 0.0
    kinetic = result["C1"].diagonal(dim1=0, dim2=1).sum(-1)
    assert_close(kinetic, torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.thorough
def test_frequencies_move_with_the_ply_angles():
    """d Kr / d angle, forward mode through section and beam, against differences; lanes are the loop."""
    body = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.6, 6), strip(20.0, -50.0), modes=3, reference="start")
    angles = body.get_parameter("section.angles").detach()

    def frequencies(a):
        return torch.linalg.eigvalsh(functional_call(_Structure(body), {"body.section.angles": a}))

    exact = jacfwd(frequencies)(angles)
    h = torch.eye(2, dtype=torch.float64) * 1e-4
    rough = torch.stack([(frequencies(angles + e) - frequencies(angles - e)) / 2e-4 for e in h], dim=-1)
    assert_close(exact, rough, rtol=1e-5, atol=1e-5 * float(rough.abs().max()))
    lanes = torch.stack([angles, angles + 0.3])
    for lane, a in zip(frequencies(lanes), lanes, strict=True):
        alone = frequencies(a)
        assert_close(lane[-len(alone) :], alone, rtol=1e-9, atol=0)  # those of padding are 0 and come first


class _Structure(torch.nn.Module):
    def __init__(self, body):
        super().__init__()
        self.body = body

    def forward(self):
        return self.body.structure()["Kr"]


@pytest.mark.thorough
def test_a_cantilever_swings_at_its_frequency():
    """A beam fixed to the ground and released from its straight shape under gravity: sag, frequency and its mean."""
    section = GivenSection.isotropic(70e9, 0.3, 2700.0, 4e-4, 3.3e-9, 5.3e-8, 1e-8)
    length, n = 1.0, 24
    body = mbd.FlexibleBody.beam("arm", BeamLine.straight(length, n), section, modes=6, reference="start")
    ground = mbd.Ground()
    system = mbd.System([body], [mbd.Fixed(ground.at(0, 0, 0), body.at("start"))], gravity=(0.0, 0.0, -9.81))
    mass, EI, GA = 2700.0 * 4e-4, 70e9 * 3.3e-9, 5 / 6 * 70e9 / 2.6 * 4e-4
    omega = 1.8751040687**2 * math.sqrt(EI / mass) / length**2
    period = 2 * math.pi / omega
    motion = mbd.simulate(system, duration=period, steps=400)
    tip = motion.body("arm").nodes[0, :, -1, 2].detach().numpy()
    sag = mass * 9.81 * length**4 / 8 / EI + mass * 9.81 * length**2 / 2 / GA
    assert abs(tip[0]) < 1e-12
    assert -tip[200] == pytest.approx(2 * sag, rel=0.02)  # half a period: twice the static sag, higher modes beside
    assert abs(tip[-1]) < 0.03 * sag
    assert -np.mean(tip) == pytest.approx(sag, rel=0.01)


@pytest.mark.thorough
def test_a_pendulum_of_a_stiff_beam_is_the_rigid_one():
    """Turned out of every plane, off its line: the motion of the tip is that of a rigid body with its inertia."""
    section, length = coupled_section(), 0.5
    swing = turned(0.4, -0.7, 0.3)
    flexible = mbd.FlexibleBody.beam(
        "rod", BeamLine.straight(length, 40), section, modes=2, reference="start", axes=swing, position=(0.0, 0.0, 0.0)
    )
    result = {key: x.detach() for key, x in flexible.structure().items()}
    center = result["S0"] / result["mass"]
    P = result["P0"]
    about = P.trace() * torch.eye(3, dtype=torch.float64) - P
    own = about - result["mass"] * (center @ center * torch.eye(3, dtype=torch.float64) - torch.outer(center, center))
    rigid = mbd.RigidBody(
        "rod",
        mass=float(result["mass"]),
        inertia=(own + own.T) / 2,
        center=center.tolist(),
        axes=swing,
        position=(0.0, 0.0, 0.0),
    )
    ground, tips = mbd.Ground(), []
    for body, root in ((flexible, flexible.at("start")), (rigid, rigid.at(0, 0, 0))):
        system = mbd.System([body], [mbd.Spherical(ground.at(0, 0, 0), root)], gravity=(1.5, -9.0, 3.5))
        motion = mbd.simulate(system, duration=0.5, steps=200)
        state = finished(motion).body("rod")  # of a stiff beam the gross motion
        tips.append((state.r + state.A @ torch.tensor([length, 0.0, 0.0], dtype=torch.float64))[0].detach())
    assert float((tips[0] - tips[1]).norm(dim=1).max()) < 2e-4 * length
    assert float((tips[0][-1] - tips[0][0]).norm()) > 0.2 * length


@pytest.mark.thorough
def test_gradient_of_the_energy_of_a_swinging_beam():
    """Through section, beam, modes and motion, against differences."""

    def integral(degrees):
        body = mbd.FlexibleBody.beam(
            "arm", BeamLine.straight(0.4, 6), strip(*degrees), modes=3, reference="start", damping=1e-4
        )
        hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), body.at("start"), axis="y")
        system = mbd.System([body], [hinge], gravity=(0.0, 0.0, -9.81))
        motion = mbd.simulate(system, duration=0.05, steps=60, gradients="forward")
        return mbd.Integral(mbd.StrainEnergy("arm")).value_and_gradient(motion)

    start = np.array([30.0, -20.0])
    value, gradient = integral(start)
    assert float(value[0]) > 0
    for k in range(2):
        e = np.eye(2)[k] * 0.05
        rough = (integral(start + e)[0] - integral(start - e)[0]) / (2 * math.radians(0.05))
        assert gradient is not None
        assert float(gradient[0, k]) == pytest.approx(float(rough[0]), rel=2e-4)
