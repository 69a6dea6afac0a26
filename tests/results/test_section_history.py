"""Stresses of beams along a motion: closed forms, direct recovery, gradients of the failure index against differences."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.sections.section_cases import ANBA
from tests.mechanisms import turned
from tests.refused import refused
from torchmbd.fem import sections
from torchmbd.fem.elements import BeamLine, GivenSection
from torchmbd.fem.materials import CRITERIA, Strength
from torchmbd.fem.sections import Orthotropic
from torchmbd.integrate import Trajectory

STRENGTH = Strength(Xt=1e7, Xc=7e6, Yt=5e5, Yc=1.5e6, S12=7e5, S13=7e5, S23=7e5)
STEP = 1e-5


def strip(*degrees: float) -> sections.Section:
    plies = [
        dataclasses.replace(ANBA, density=1600.0, strength=dataclasses.replace(STRENGTH, Yt=2e5 * (2 + k)))
        for k in range(len(degrees))
    ]
    return sections.strip(width=0.03, ply=plies, angles=mbd.deg(list(degrees)), thickness=1e-3, cells=(4, 1))


def swinging(*degrees: float) -> mbd.System:
    """A laminated beam, twisted by itself, hinged out of plane."""
    line = BeamLine.straight(0.4, 4)
    twist = torch.tensor([[0.1 * k, 0.1 * k + 0.1] for k in range(4)])
    arm = mbd.FlexibleBody.beam(
        "arm", line, strip(*degrees), modes=4, reference="start", damping=1e-4, twist=twist, axes=turned(0.3, -0.5, 0.2)
    )
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), arm.at("start"), axis="y")
    return mbd.System([arm], [hinge], gravity=(1.0, 3.0, -9.0))


@pytest.fixture(scope="module")
def motions() -> tuple[Trajectory, Trajectory]:
    """Two designs with sensitivities, and their neighbors as lanes."""
    result, options = swinging(30.0, -20.0), {"steps": 40, "iterations": (6, 6), "refresh": 1}
    angles = mbd.deg([[30.0, -20.0], [75.0, 10.0]])
    steps = STEP * torch.eye(2, dtype=torch.float64)
    near = torch.cat([angles[:, None] + steps, angles[:, None] - steps], 1).flatten(0, 1)
    return tuple(
        mbd.simulate(result, 0.04, gradients=way, designs={"arm.section.angles": x}, **options).require_ok()
        for way, x in (("forward", angles), ("none", near))
    )


@pytest.mark.thorough
def test_a_cantilever_under_its_weight_has_the_stress_of_the_book():
    """Come to rest after many damped periods: M z / I with M = m g (l - x)^2 / 2, at both ends of every element."""
    b, h, length, n = 0.02, 0.03, 0.8, 4
    section = sections.rectangle(b, h, Orthotropic.isotropic(210e9, 0.3, 7850.0), cells=(4, 6))
    omega = 1.875104**2 * math.sqrt(210e9 * h**2 / 12 / 7850.0) / length**2
    arm = mbd.FlexibleBody.beam(
        "arm", BeamLine.straight(length, n), section, modes=6 * n, reference="start", damping=1.0 / omega
    )
    ground = mbd.Ground()
    system = mbd.System([arm], [mbd.Fixed(ground.at(0, 0, 0), arm.at("start"))], gravity=(0.0, 0.0, -9.81))
    motion = mbd.simulate(system, duration=30.0 / omega, steps=120).require_ok()
    result = mbd.SectionHistory(motion, "arm")
    last, load = slice(-1, None), 7850.0 * b * h * 9.81
    z = result.points()[:, 1]
    stress, forces = result.stress(times=last)[0, 0].detach(), result.forces(times=last)[0, 0].detach()
    edge = load * length**2 / 2 * h / 2 / (b * h**3 / 12)
    for (element, end), own, force in zip(result.ends().tolist(), stress, forces, strict=True):
        # the weight acts at the nodes: half an element's at either side of a section
        x = length * (element + end) / n
        moment, lumped = load * (length - x) ** 2 / 2, load * (length - length * (element + 0.5) / n)
        assert float(force[4]) == pytest.approx(moment, abs=1e-5 * load)
        assert float(force[2]) == pytest.approx(-lumped, rel=1e-5)
        assert_close(own[:, 0], moment * z / (b * h**3 / 12), rtol=0, atol=2e-5 * edge)


def test_it_is_the_stress_of_the_deformed_beam(motions):
    """In a lane with its own angles: section forces of the deformed nodes, and the section's own recovery."""
    motion, lane, time = motions[0], 1, 17
    history, view = mbd.SectionHistory(motion, "arm"), motion.body("arm")
    field = torch.einsum("nim,m->ni", view.psi[lane], view.w[lane, time])[..., None]
    own = swinging(*torch.rad2deg(motion.designs["arm.section.angles"][lane]).tolist()).body("arm")
    beams = own.beams["section0"]
    force = beams.section_forces(field).detach()[..., 0].flatten(0, 1)
    scale = force.abs().amax(0)
    assert_close(history.forces(times=slice(time, time + 1))[lane, 0] / scale, force / scale, rtol=0, atol=1e-8)
    direct = own.section.stress(force)
    element, point = own.section.stress_points.unbind(1)
    expected = direct.stress[:, element, point].detach()
    result = history.stress(times=slice(time, time + 1))[lane, 0]
    assert_close(result, expected, rtol=0, atol=1e-8 * float(expected.abs().max()))
    assert_close(history.points(), direct.points[element, point])
    assert history.ends().tolist() == [[k, end] for k in range(4) for end in range(2)]


@pytest.mark.parametrize("criterion", CRITERIA)
def test_the_failure_index_is_the_largest_of_all_points(criterion, motions):
    history = mbd.SectionHistory(motions[0], "arm")
    layer = strip(30.0, -20.0).geometry.layer[history._section("section0").stress_points[:, 0]]
    weak = torch.stack([dataclasses.replace(STRENGTH, Yt=2e5 * (2 + k)).numbers() for k in range(2)])[layer]
    everywhere = CRITERIA[criterion](history.stress()[..., [0, 1, 5, 4, 3]], weak)
    assert_close(history.failure(criterion), everywhere.flatten(2).amax(-1), rtol=1e-9, atol=1e-12)
    assert history.critical(criterion).shape == (2, 41, 2)
    assert float(everywhere.amax()) > 0.05


@pytest.mark.thorough
@pytest.mark.parametrize("criterion", CRITERIA)
def test_gradient_of_the_history_against_differences(criterion, motions):
    """Where the critical point is the same on both sides; elsewhere the index has a kink."""
    value, gradient = mbd.PlyFailure("arm", criterion).series(motions[0])
    up, down = mbd.PlyFailure("arm", criterion).values(motions[1]).unflatten(0, (2, 2, 2)).unbind(1)
    expected = ((up - down) / (2 * STEP)).movedim(1, -1)
    place = mbd.SectionHistory(motions[1], "arm").critical(criterion).unflatten(0, (2, 4))
    unique = (place == place[:, :1]).all(-1).all(1)
    assert float(unique.double().mean()) > 0.8
    scale = float(expected[unique].abs().max())
    assert scale > 1e-3
    assert_close(gradient[unique], expected[unique], rtol=0, atol=1e-6 * scale)
    assert value.shape == (2, 41)


@pytest.mark.thorough
def test_the_door_names_what_is_missing(motions):
    history = mbd.SectionHistory(motions[0], "arm")
    with refused("arm.part", "section1", meant="section0"):
        history.forces("section1")
    for criterion in ("tsai_wo", ["tsai_wo"]):
        with refused("criterion", meant="tsai_wu"):
            history.failure(criterion)
    given = GivenSection.isotropic(70e9, 0.3, 2700.0, 4e-4, 3.3e-9, 5.3e-8, 1e-8)
    arm = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.4, 2), given, modes=2, reference="start")
    system = mbd.System([arm], [mbd.Fixed(mbd.Ground().at(0, 0, 0), arm.at("start"))])
    motion = mbd.simulate(system, 1e-3, steps=2)
    with refused("body", "arm"):
        mbd.SectionHistory(motion, "arm").failure()
    with refused("arm.section0"):
        mbd.SectionHistory(motion, "arm").stress()
    assert mbd.SectionHistory(motion, "arm").forces().shape == (1, 3, 4, 6)
    with refused("body", "arm"):
        mbd.PlyFailure("arm").check(system)
    weak = dataclasses.replace(ANBA, density=1600.0)
    bare = sections.strip(width=0.03, ply=weak, angles=mbd.deg([0.0]), thickness=1e-3, cells=(2, 1))
    arm = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.4, 2), bare, modes=2, reference="start")
    with refused("body", "arm"):
        mbd.PlyFailure("arm").check(mbd.System([arm], [mbd.Fixed(mbd.Ground().at(0, 0, 0), arm.at("start"))]))
