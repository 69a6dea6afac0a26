"""Adaptive methods in phases: a switch that changes nothing costs a restart, whatever the number of outputs."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd


def rotor() -> mbd.System:
    body = mbd.RigidBody("rotor", 1.0, (1.0, 1.0, 1.0), center=(0.3, 0.0, 0.0))
    frames = mbd.Ground().at(), body.at()
    spring = mbd.RotationalSpringDamper(*frames, "z", stiffness=5.0, damping=0.05)
    return mbd.System([body], [mbd.Revolute(*frames, axis="z", name="hinge")], [spring], gravity=(0.0, -9.81, 0.0))


NOTHING = mbd.Event(lambda motion: motion.t.expand(motion.lanes, -1) - 0.301, "rising")


@pytest.mark.thorough
@pytest.mark.parametrize("until", [0.3, 0.3001])
@pytest.mark.parametrize("steps", [20, 200])
def test_a_switch_that_changes_nothing_costs_a_restart(until, steps):
    options = {"method": "dopri5", "rtol": 1e-7, "atol": 1e-8, "gradients": "none", "backend": "eager"}
    plain = mbd.simulate(rotor(), 1.0, steps=steps, **options)
    switched = mbd.simulate(rotor(), 1.0, steps=steps, phases=[mbd.Phase(until=until), mbd.Phase()], **options)
    assert switched.stats["evaluations"] < plain.stats["evaluations"] + 60
    assert_close(switched.q, plain.q, rtol=0, atol=1e-5)


@pytest.mark.thorough
def test_an_event_costs_little_more():
    options = {"method": "dopri5", "rtol": 1e-6, "atol": 1e-8, "gradients": "none", "backend": "eager"}
    plain = mbd.simulate(rotor(), 1.0, steps=200, **options)
    switched = mbd.simulate(rotor(), 1.0, steps=200, phases=[mbd.Phase(until=NOTHING), mbd.Phase()], **options)
    assert switched.switches[0].t.item() == pytest.approx(0.301, abs=1e-9)
    assert switched.stats["evaluations"] < 2 * plain.stats["evaluations"]
    assert torch.isfinite(switched.q).all()
