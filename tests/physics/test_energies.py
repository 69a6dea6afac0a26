"""The energy balance: energies against sums over the nodes, and balanced to the order of the method."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, box, laminate, pendulum, plate, turned
from tests.physics.nodal_sums import sums
from tests.refused import refused

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.thorough
def test_energies_are_those_of_the_nodes():
    motion = mbd.simulate(pendulum(), 0.05, steps=50).require_ok()
    result, expected = motion.energies, sums(motion)
    for name in ("kinetic", "strain", "potential"):
        assert_close(getattr(result, name)[0], getattr(expected, name), rtol=1e-9, atol=1e-12)


def driven_arm() -> mbd.System:
    """A driven arm, a soft damped plate on a spring and a bushing, a load in time, gravity: all terms of the balance."""
    ground = mbd.Ground()
    arm = box("arm", axes=turned(0.0, 0.0, 0.3))
    soft = laminate((20.0, -50.0), 3e-3, SOFT)
    rod = plate("rod", modes=2, made_of=soft, position=(0.3, 0.0, 0.0), damping=1e-3)
    joints = [
        mbd.Revolute(ground.at(), arm.at(), axis="z"),
        mbd.Drive(ground, arm, axis="z", angle=lambda t: 30.0 * t * t),
        mbd.Spherical(arm.at(0.15, 0.0, 0.0), rod.at("left")),
    ]
    forces = [
        mbd.SpringDamper(ground.at(0.5, 0.2, 0.1), rod.at("right"), stiffness=300.0, damping=2.0, rest=0.1),
        mbd.RotationalSpringDamper(arm.at(), rod.at("left"), stiffness=2.0, damping=0.02),
        mbd.Force(rod.at("right"), lambda t: torch.stack([torch.sin(40.0 * t), 2.0 * t, 0.0 * t + 1.0])),
    ]
    return mbd.System([arm, rod], joints, forces, gravity=GRAVITY)


@pytest.mark.thorough
def test_the_balance_closes_to_second_order():
    system, worst = driven_arm(), []
    for steps in (100, 200):
        motion = mbd.simulate(system, 0.1, steps=steps, spectral_radius=0.95).require_ok()
        result = motion.energies
        for name in ("kinetic", "strain", "potential", "dissipated", "applied", "driven"):
            term = getattr(result, name)
            assert float((term - term[:, :1]).abs().max()) > 1e-3, name
        worst.append(float(result.balance.abs().max() / result.kinetic.max()))
    assert worst[1] < 2e-3
    assert worst[0] / worst[1] == pytest.approx(4.0, rel=0.35)


@pytest.mark.thorough
@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("gradients", ["none", "reverse", "forward"])
def test_energies_with_checkpoints_are_those_without(gradients, several):
    """Works are integrals over all steps, not over the states that are kept."""
    phases = [mbd.Phase(until=0.0503), mbd.Phase(lasting=0.02), mbd.Phase()] if several else None
    options = {"steps": 60, "gradients": gradients, "backend": "eager", "phases": phases}
    whole = mbd.simulate(driven_arm(), 0.1, **options)
    some = mbd.simulate(driven_arm(), 0.1, **options, checkpoint=20)
    for name in ("kinetic", "strain", "potential", "dissipated", "applied", "driven", "lost", "balance"):
        expected = getattr(whole.energies, name)[:, ::20]
        assert_close(getattr(some.energies, name).detach(), expected.detach(), rtol=1e-12, atol=1e-12)
    if gradients == "reverse":
        with refused("checkpoint"):
            some.energies.applied.sum().backward()


@pytest.mark.thorough
def test_lanes_keep_their_own_books():
    system = pendulum()
    angles = system.body("rod").laminate.angles.detach()
    designs = {"rod.laminate.angles": torch.stack([angles, angles + 0.4])}
    both = mbd.simulate(system, 0.02, steps=20, designs=designs).require_ok().energies
    second = mbd.simulate(system, 0.02, steps=20, designs={"rod.laminate.angles": angles[None] + 0.4}).energies
    assert_close(both.strain[1:], second.strain, rtol=1e-8, atol=1e-14)
    assert not torch.allclose(both.strain[0], both.strain[1], rtol=1e-3)


@pytest.mark.thorough
def test_a_force_by_a_function_of_one_time_does_its_work():
    """The function takes one time, not many."""
    block, full = mbd.RigidBody("block", 2.0, (0.01, 0.01, 0.01)), torch.tensor([3.0, 0.0, 1.0], dtype=torch.float64)
    system = mbd.System([block], [], [mbd.Force(block.at(), lambda t: full * torch.sin(t))], free=["block"])
    result = mbd.simulate(system, 1.0, steps=100).energies
    assert float(result.applied[0, -1]) > 0.1
    assert_close(result.applied[0], result.kinetic[0], rtol=1e-3, atol=1e-4)
