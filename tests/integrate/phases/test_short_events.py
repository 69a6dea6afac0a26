"""Events shorter than a step: a thrown point passes a plane twice, or bounces, between two output times; closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor

G, SPEED = 9.81, 1.0
STEPS, DURATION = 10, 0.3  # the point is highest at 0.1019 s, between the output times 0.09 s and 0.12 s


def thrown(speed: float = SPEED) -> mbd.System:
    """A point thrown upwards; its pull is a design variable."""
    body = mbd.RigidBody("mass", mass=2.0, inertia=(0.1, 0.2, 0.2), velocity=(0.0, 0.0, speed))
    return mbd.System([body], forces=[mbd.Force(body.at(), (0.0, 0.0, mbd.variable(-2.0 * G)), name="pull")])


def passes(level: float, pull: Tensor, sign: float) -> Tensor:
    """When the point passes a level upwards (sign -1) or downwards (1)."""
    g = -0.5 * pull
    return (SPEED + sign * torch.sqrt(SPEED * SPEED - 2.0 * g * level)) / g


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
@pytest.mark.parametrize(("direction", "sign"), [("rising", -1.0), ("falling", 1.0), ("either", -1.0)])
def test_a_point_that_passes_a_plane_twice_in_one_step(method, direction, sign):
    level = 0.0506  # 0.4 mm below the highest point
    event = mbd.Event(lambda motion: motion.body("mass").r[..., 2] - level, direction)
    motion = mbd.simulate(thrown(), DURATION, method, STEPS, phases=[mbd.Phase(until=event), mbd.Phase()]).require_ok()
    time = passes(level, tensor(-2.0 * G), sign)
    assert 0.09 < float(time) < 0.12
    assert_close(motion.switches[0].t.detach(), time, rtol=0, atol=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["forward", "reverse"])
def test_its_time_has_the_gradient_of_the_closed_form(gradients):
    """Lanes of which one passes in one step, one in two, and one never."""
    pulls, level = tensor(-19.62, -19.0, -25.0), 0.0506
    event = mbd.Event(lambda motion: motion.body("mass").r[..., 2] - level, "falling")
    motion = mbd.simulate(
        thrown(),
        DURATION,
        steps=STEPS,
        designs={name: pulls for name, _ in thrown().named_parameters()},
        phases=[mbd.Phase(until=event), mbd.Phase()],
        gradients=gradients,
    )
    assert [status == "ok" for status in motion.status] == [True, True, False]
    exact = pulls[:2].clone().requires_grad_()
    times = passes(level, exact, 1.0)
    (slopes,) = torch.autograd.grad(times.sum(), exact)
    t = motion.switches[0].t
    assert_close(t[:2].detach(), times.detach(), rtol=0, atol=1e-10)
    if gradients == "reverse":
        (result,) = torch.autograd.grad(t[:2].sum(), list(motion.variables.values()))
        assert_close(result[:2], slopes, rtol=1e-9, atol=0)
    else:
        assert motion.switches[0].dt_db is not None
        assert_close(motion.switches[0].dt_db[:2, 0], slopes, rtol=1e-9, atol=0)


def test_a_plane_just_above_the_highest_point_is_not_reached():
    event = mbd.Event(lambda motion: motion.body("mass").r[..., 2] - 0.0510)
    motion = mbd.simulate(thrown(), DURATION, steps=STEPS, phases=[mbd.Phase(until=event, name="up"), mbd.Phase()])
    assert "phase 'up' never ends" in motion.status[0]


@pytest.mark.thorough
def test_bounces_that_are_shorter_than_a_step():
    """A point dropped from 0.2 m, restitution 0.1: it is in the air for 0.0404 s, then for 0.004 s."""
    body = mbd.RigidBody("mass", mass=2.0, inertia=(0.1, 0.2, 0.2), position=(0.0, 0.0, 0.2))
    system = mbd.System([body], gravity=(0.0, 0.0, -G))
    landing = mbd.Phase(until=mbd.Event(mbd.Position("mass", axis="z"), "falling"), impact=0.1)
    motion = mbd.simulate(system, 0.5, steps=5, phases=[landing, landing, landing, mbd.Phase(lock=[])]).require_ok()
    first = math.sqrt(0.4 / G)
    times = first * tensor(1.0, 1.2, 1.22)
    assert_close(torch.stack([switch.t[0] for switch in motion.switches]), times, rtol=0, atol=1e-9)


@pytest.mark.thorough
def test_steps_that_are_too_long_to_know_are_told():
    """A function of time that turns several times in every step."""
    event = mbd.Event(lambda motion: 1.001 + torch.sin(300.0 * motion.t).expand(motion.lanes, -1))
    motion = mbd.simulate(thrown(), DURATION, steps=STEPS, phases=[mbd.Phase(until=event), mbd.Phase()])
    assert "never ends" in motion.status[0]

    def late(motion: mbd.Trajectory) -> Tensor:
        wave = 1.001 + torch.sin(300.0 * motion.t)
        return torch.where(motion.t < 0.25, wave, 0.25 - motion.t).expand(motion.lanes, -1)

    phases = [mbd.Phase(until=mbd.Event(late), name="up"), mbd.Phase()]
    motion = mbd.simulate(thrown(), DURATION, steps=STEPS, phases=phases)
    assert motion.status[0].startswith(
        "unresolved: the steps are too long to know whether the event of phase 'up' occurs"
    )
