"""Reactions that alternate from step to step: the amplitude is their error, and a warning names joint, kind and time."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import box
from tests.refused import warned
from torchmbd.results.ringing import alternation

DURATION = 0.5  # [s]


END = 0.2  # [s] of the acceleration of the motor


def uneven(t: torch.Tensor) -> torch.Tensor:
    """An angle whose acceleration of 20 rad/s2 ends at once."""
    return torch.where(t < END, 10.0 * t**2, 10.0 * END**2 + 20.0 * END * (t - END))


def driven(law: Any = uneven) -> mbd.System:
    """A body on a hinge that a motor turns, from rest."""
    ground, arm = mbd.Ground(), box("arm", position=(0.3, 0.0, 0.0))
    frames = ground.at(), arm.at(-0.3, 0.0, 0.0)
    motor = mbd.Drive(*frames, axis="z", angle=law, name="motor")
    return mbd.System([arm], [mbd.Revolute(*frames, axis="z", name="hinge"), motor])


@pytest.mark.thorough
def test_amplitude_is_the_error_after_a_jump_of_the_acceleration() -> None:
    motion = mbd.simulate(driven(), DURATION, steps=40, diagnose=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torque = motion.reaction("motor").torque.detach()[0]
    after = motion.t > END + 1e-9
    exact = torque[1, 2] * ~after  # of a constant acceleration, then of none
    error = (torque[:, 2] - exact)[after].abs()
    assert float(alternation(torque)[after[2:-2]].max() / error.max()) == pytest.approx(1.0, abs=0.2)
    assert error.max() > 0.3 * torque.norm(dim=-1).max()


@pytest.mark.thorough
def test_the_torque_of_a_smooth_start_does_not_ring() -> None:
    """Its first steps begin without a transient of the multipliers (integrate/smooth_start.py)."""
    system, torques = driven(mbd.SmoothStep(2.0, DURATION)), []
    for steps in (80, 1280):
        motion = mbd.simulate(system, DURATION, steps=steps)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            torques.append(motion.reaction("motor").torque.detach()[0, :: steps // 80, 2])
    coarse, fine = torques
    assert (coarse - fine).abs().max() < 0.01 * fine.abs().max()


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
def test_what_helps_is_not_told() -> None:
    motion = mbd.simulate(driven(), DURATION, steps=40, spectral_radius=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mbd.Max(mbd.Reaction("motor", "z", "torque"), window=(0.3, DURATION))(motion)


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
