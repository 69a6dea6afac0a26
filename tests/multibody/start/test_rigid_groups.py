"""Exact beams at the start: joints close by rigid motions where they can, without strain, and what strains a beam is told."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.refused import warned

GROUND = mbd.Ground()
SECTION = mbd.GivenSection.isotropic(E=70e9, nu=0.3, density=2700.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)


def boom(end: type | None = None, place: float = 0.0, offset: float = 0.0) -> mbd.System:
    """A beam on a crank, whose pin varies; end: a joint to the ground at the other end; place, offset: of the beam."""
    crank = mbd.RigidBody("crank", 1.0, (0.1, 0.1, 0.1))
    beam = mbd.FlexibleBeam("boom", mbd.BeamLine.straight(1.0, 6), SECTION, position=(0.2 + offset, place, 0.0))
    joints = [
        mbd.Revolute(GROUND.at(), crank.at(), axis="z", name="hinge"),
        mbd.Drive(GROUND.at(), crank.at(), axis="z", angle=lambda t: t**2, name="motor"),
        mbd.Revolute(crank.at(mbd.variable(0.2), 0.0, 0.0), beam.at("start"), axis="z", name="pin"),
    ]
    if end is not None:
        more = {"normal": "y"} if end is mbd.PointOnPlane else {}
        joints.append(end(GROUND.at(1.2, 0, 0), beam.at("end"), name="tip", **more))
    return mbd.System([crank, beam], joints)


def moved(system: mbd.System, x: float) -> dict[str, Tensor]:
    """The design whose pin is x [m] farther out."""
    (name,) = [name for name, _ in system.named_parameters() if name.startswith("pin")]
    return {name: torch.tensor([0.2 + x], dtype=torch.float64)}


@pytest.mark.thorough
@pytest.mark.parametrize("x", [3e-5, 3e-3, 0.1])
def test_a_joint_that_the_design_moves_strains_no_beam(x):
    system = boom()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        motion = mbd.simulate(system, 1e-3, steps=4, designs=moved(system, x), gradients="none")
    assert float(motion.body("boom").strain_energy[0, 0]) < 1e-12
    assert float(motion.body("boom").nodes[0, 0, 0, 0]) == pytest.approx(0.2 + x, abs=1e-12)


@pytest.mark.thorough
def test_a_beam_that_turns_far_stays_straight():
    """Put across its joints: both ends go where they belong, by a finite rotation."""
    system = boom(mbd.PointOnPlane, place=0.3)
    with warned("open"):
        motion = mbd.simulate(system, 1e-3, steps=4, gradients="none")
    assert float(motion.body("boom").strain_energy[0, 0]) < 1e-12


@pytest.mark.thorough
def test_derivatives_of_the_start_are_those_of_rigid_motions():
    """All nodes go with the pin, forward and reverse, from a gap and from none."""
    for offset in (0.0, 0.02):
        system = boom(offset=offset)
        (name,) = moved(system, 0.0)

        def places(x: Tensor, system: mbd.System = system, name: str = name) -> Tensor:
            motion = mbd.simulate(system, 1e-4, steps=2, designs={name: x})
            return motion.body("boom").nodes[0, 0, :, 0]

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            x = dict(system.named_parameters())[name].detach().reshape(1)
            by = torch.func.jacrev(places)(x).flatten()
            forward = torch.func.jvp(places, (x,), (torch.ones_like(x),))[1]
        torch.testing.assert_close(by, torch.ones(7, dtype=torch.float64), atol=1e-9, rtol=0.0)
        torch.testing.assert_close(forward, torch.ones(7, dtype=torch.float64), atol=1e-9, rtol=0.0)


@pytest.mark.thorough
def test_what_strains_a_beam_is_told():
    """Between two pins 3 mm too far apart: E A d^2 / (2 L) if it stretches alone."""
    system = boom(mbd.Spherical)
    with warned("exact beams", " J"):
        motion = mbd.simulate(system, 1e-4, steps=2, designs=moved(system, -3e-3), gradients="none")
    assert float(motion.body("boom").strain_energy[0, 0]) > 0.5 * 70e9 * 1e-4 * 3e-3**2 / 1.0
