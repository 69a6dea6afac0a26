"""Reactions that alternate from step to step: the amplitude is their error, and a warning names joint, kind and time."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import box
from tests.refused import warned
from torchmbd.results.ringing import alternation

DURATION = 0.5  # [s]


def driven() -> mbd.System:
    """A body on a hinge that a motor turns by 2 rad in half of a second, from rest."""
    ground, arm = mbd.Ground(), box("arm", position=(0.3, 0.0, 0.0))
    frames = ground.at(), arm.at(-0.3, 0.0, 0.0)
    motor = mbd.Drive(*frames, axis="z", angle=mbd.SmoothStep(2.0, DURATION), name="motor")
    return mbd.System([arm], [mbd.Revolute(*frames, axis="z", name="hinge"), motor])


def torque(steps: int, **options: float) -> torch.Tensor:
    motion = mbd.simulate(driven(), DURATION, steps=steps, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return motion.reaction("motor").torque.detach()


@pytest.mark.thorough
def test_amplitude_is_the_error_of_the_first_steps() -> None:
    coarse, fine = torque(40), torque(1280)[:, ::32]
    error = (coarse - fine).norm(dim=-1)[0, :20].max()
    assert float(alternation(coarse)[0, :20].max() / error) == pytest.approx(1.0, abs=0.2)
    assert error > 0.3 * fine.norm(dim=-1).max()


@pytest.mark.thorough
@pytest.mark.parametrize(
    "read", [lambda m: m.reaction("motor"), lambda m: mbd.Max(mbd.Reaction("motor", "z", "torque"))(m)]
)
def test_a_torque_that_rings_is_told(read) -> None:
    motion = mbd.simulate(driven(), DURATION, steps=40)
    with warned("torque of joint 'motor'", "spectral_radius"):
        read(motion)


@pytest.mark.parametrize("phases", [None, [mbd.Phase(until=0.4), mbd.Phase()]])
@pytest.mark.parametrize("kind", [mbd.Max, mbd.Integral])
def test_measures_tell_a_torque_that_rings_whatever_the_phases(kind, phases) -> None:
    motion = mbd.simulate(driven(), DURATION, steps=40, phases=phases, gradients="none")
    with warned("torque of joint 'motor'", "until t = "):
        kind(mbd.Reaction("motor", "z", "torque"))(motion)


@pytest.mark.thorough
@pytest.mark.parametrize(("steps", "options"), [(640, {}), (40, {"spectral_radius": 0.0})])
def test_what_helps_is_not_told(steps: int, options: dict[str, float]) -> None:
    motion = mbd.simulate(driven(), DURATION, steps=steps, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mbd.Max(mbd.Reaction("motor", "z", "torque"), window=(0.1, DURATION))(motion)


@pytest.mark.thorough
def test_a_jump_of_a_reaction_at_a_switch_is_no_ringing() -> None:
    arm = box("arm", position=(0.3, 0.0, 0.0), angular_velocity=(0.0, 0.0, 5.0))
    hinge = mbd.Revolute(mbd.Ground().at(), arm.at(-0.3, 0.0, 0.0), axis="z", name="hinge")
    system = mbd.System([arm], [hinge], gravity=(0.0, -9.81, 0.0))
    motion = mbd.simulate(system, 0.2, steps=400, phases=[mbd.Phase(until=0.1), mbd.Phase(lock=[hinge])])
    force = motion.reaction("hinge").force[0].detach()
    assert (force[1:] - force[:-1]).norm(dim=-1).max() > 0.3 * force.norm(dim=-1).max()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion.reaction("hinge")
        mbd.Max(mbd.Reaction("hinge", "y"))(motion)


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{"steps": 200, "checkpoint": 20}, {"steps": 10, "method": "dopri5"}])
def test_few_states_of_a_resolved_motion_are_no_ringing(options: dict) -> None:
    """Two states to a period of an accurate vibration alternate, but are no errors of steps."""
    bob = box("bob", velocity=(1.0, 0.0, 0.0))
    spring = mbd.SpringDamper(mbd.Ground().at(-1.0, 0.0, 0.0), bob.at(), stiffness=(20.0 * math.pi) ** 2, rest=1.0)
    post = box("post", position=(0.0, 1.0, 0.0))
    hold = mbd.Fixed(mbd.Ground().at(0.0, 1.0, 0.0), post.at(), name="hold")
    guide = mbd.Prismatic(mbd.Ground().at(), bob.at(), axis="x")
    pull = mbd.SpringDamper(post.at(), bob.at(), stiffness=100.0, rest=0.0)
    motion = mbd.simulate(mbd.System([bob, post], [hold, guide], [spring, pull]), 0.5, gradients="none", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion.reaction("hold")


def test_a_resolved_vibration_does_not_alternate() -> None:
    t = torch.linspace(0.0, 6.0, 61, dtype=torch.float64)
    x = torch.stack([t.sin(), (3.0 * t).cos(), 0.0 * t], dim=-1)
    assert float(alternation(x).max()) < 1e-3
    assert float(alternation(x + 0.1 * (-1.0) ** torch.arange(61)[:, None])[20:40].mean()) == pytest.approx(
        0.1 * 3**0.5, rel=0.1
    )
