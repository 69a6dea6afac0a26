"""Errors by steps: a load whose period divides a step is not called resolved, wherever it enters the motion."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import torchmbd as mbd

STEPS, DURATION, MASS = 50, 0.5, 2.0  # 100 steps a second


def law(frequency: float, part: str) -> Callable[[Tensor], Tensor]:
    wave = torch.sin if part == "sine" else torch.cos
    return lambda t: 40.0 * wave(2.0 * math.pi * frequency * t)


def place(frequency: float, part: str) -> float:
    """x of the mass, from rest at 1 m, at the end: 40 N of whole periods leave the velocity of a sine alone."""
    return 1.0 + (40.0 / MASS / (2.0 * math.pi * frequency) * DURATION if part == "sine" else 0.0)


def sliding() -> tuple[mbd.RigidBody, mbd.Prismatic]:
    body = mbd.RigidBody("mass", MASS, (0.1, 0.1, 0.1), position=(1.0, 0.0, 0.0))
    return body, mbd.Prismatic(mbd.Ground().at(), body.at(), axis="x", name="rail")


def pushed(f: Callable[[Tensor], Tensor]) -> tuple[mbd.System, dict]:
    body, rail = sliding()
    push = mbd.Force(body.at(), lambda t: torch.stack([f(t), 0.0 * t, 0.0 * t]), name="push")
    return mbd.System([body], [rail], [push]), {}


class Motor(torch.nn.Module):
    """A force that is a function of the time."""

    def __init__(self, f: Callable[[Tensor], Tensor]):
        super().__init__()
        self.f = f

    def forward(self, x: Tensor) -> Tensor:
        return self.f(x)


def controlled(f: Callable[[Tensor], Tensor]) -> tuple[mbd.System, dict]:
    body, rail = sliding()
    motor = mbd.Controller(Motor(f), [mbd.signals.Time()], [mbd.signals.JointForce(rail)], name="motor")
    return mbd.System([body], [rail], [motor]), {}


def in_a_phase(f: Callable[[Tensor], Tensor]) -> tuple[mbd.System, dict]:
    body, rail = sliding()
    push = mbd.SpringDamper(mbd.Ground().at(), body.at(), stiffness=1e-9, name="push")
    return mbd.System([body], [rail], [push]), {"phases": [mbd.Phase(laws={"push": lambda s, rate, t: 0.0 * s + f(t)})]}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("system", "frequency", "part"),
    [
        (pushed, 200.0, "sine"),
        (pushed, 200.0, "cosine"),
        (pushed, 400.0, "cosine"),
        (pushed, 600.0, "sine"),
        (controlled, 200.0, "cosine"),
        (controlled, 800.0, "sine"),
        (in_a_phase, 400.0, "sine"),
        (in_a_phase, 1000.0, "cosine"),
    ],
)
def test_a_load_of_whole_periods_in_a_step(system, frequency, part):
    """100 steps a second, and 200, and 50: each takes the load for a constant."""
    model, options = system(law(frequency, part))
    motion = mbd.simulate(model, DURATION, steps=STEPS, gradients="none", **options)
    error = motion.error_of(mbd.Final(mbd.Position("mass", "x")), modes=False, mesh=False)
    off = abs(place(frequency, part) - error.value.item())
    assert off > 1e-3
    assert not error.resolved.item() or abs(error.by_steps.item()) > 0.5 * off


@pytest.mark.thorough
@pytest.mark.parametrize(("frequency", "steps"), [(11.0, 400), (11.0, 401), (3.7, 300)])
def test_a_load_that_the_steps_show(frequency, steps):
    model, _ = pushed(law(frequency, "sine"))
    error = mbd.simulate(model, DURATION, steps=steps, gradients="none").error_of(mbd.Final(mbd.Position("mass", "x")))
    rest, omega = 2.0 * math.pi * frequency * DURATION, 2.0 * math.pi * frequency
    exact = 1.0 + 40.0 / MASS / omega * (DURATION - math.sin(rest) / omega)
    assert error.resolved.item()
    assert error.by_steps.item() == pytest.approx(exact - error.value.item(), rel=0.05)
