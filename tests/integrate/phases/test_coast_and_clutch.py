"""Phases without a drive whose locks make rows redundant: values and gradients in every mode by closed forms.

A driver [Iz] turns at w until 0.2 rad and is then clutched to a wheel [Jz] at rest: w Iz / (Iz + Jz) from there on.
"""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor

SPEED, DRIVER, WHEEL, ANGLE, END = 2.0, 0.02, 0.03, 0.2, 0.4


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["none", "forward", "reverse"])
def test_the_angle_after_the_clutch(gradients):
    ground, inertia = mbd.Ground(), torch.nn.Parameter(tensor(DRIVER, DRIVER, DRIVER))
    driver = mbd.RigidBody("driver", 1.0, inertia, angular_velocity=(0.0, 0.0, SPEED))
    wheel = mbd.RigidBody("wheel", 1.0, (0.02, 0.02, WHEEL))
    joints = [
        mbd.Revolute(ground.at(), driver.at(), "z", name="a"),
        mbd.Revolute(ground.at(), wheel.at(), "z", name="b"),
        mbd.Revolute(driver.at(), wheel.at(), "z", name="clutch"),
    ]
    until = mbd.Event(mbd.Angle("driver", "z") - ANGLE, "rising")
    phases = [mbd.Phase(until=until, lock=["b"]), mbd.Phase(lock=["clutch"])]
    motion = mbd.simulate(mbd.System([driver, wheel], joints), END, steps=40, phases=phases, gradients=gradients)
    response, rest = mbd.Final(mbd.Angle("driver", "z")), END - ANGLE / SPEED
    assert_close(response(motion).detach(), tensor(ANGLE + rest * SPEED * DRIVER / (DRIVER + WHEEL)), rtol=1e-9, atol=0)
    if gradients != "none":
        slope = rest * SPEED * WHEEL / (DRIVER + WHEEL) ** 2
        assert_close(response.value_and_gradient(motion)[1], tensor(0.0, 0.0, slope)[None], rtol=1e-8, atol=1e-9)
