"""The status tells steps that do not resolve rigid bodies on springs. Bodies that are resolved, or rest, are ok."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest

import torchmbd as mbd
from tests.refused import warned

FREQUENCY = 10.0  # [Hz]


def block(where: float = 0.1, mass: float = 1.0, turns: bool = False, damping: float = 0.0) -> mbd.System:
    """A body on a slide, or on a hinge through its center of mass, that a spring holds; it starts at `where` [m] or [rad]."""
    ground, body = mbd.Ground(), mbd.RigidBody("block", mass, (0.1 * mass,) * 3)
    k = (2.0 * math.pi * FREQUENCY) ** 2 * mass
    if turns:
        joint: Any = mbd.Revolute(ground.at(), body.at(), axis="z", name="joint")
        spring: Any = mbd.RotationalSpringDamper(ground.at(), body.at(), "z", stiffness=0.1 * k, rest=where)
    else:
        joint = mbd.Prismatic(ground.at(), body.at(), axis="x", name="joint")
        spring = mbd.AxialSpringDamper(ground.at(), body.at(), "x", stiffness=k, damping=damping, rest=where)
    return mbd.System([body], [joint], [spring])


def status(system: mbd.System, steps: int | None, duration: float = 1.0, **options: Any) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return mbd.simulate(system, duration, steps=steps, gradients="none", backend="eager", **options).status[0]


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("mass", [1e-3, 1e3])
def test_less_than_five_steps_to_a_period_are_unresolved(turns, mass) -> None:
    for steps in (5, 20, 40):
        text = status(block(mass=mass, turns=turns), steps)
        assert text.startswith("unresolved: ")
        assert "10 Hz" in text
    for steps in (80, 160):
        assert status(block(mass=mass, turns=turns), steps) == "ok"


def test_a_warning_names_the_frequency_and_enough_steps() -> None:
    with warned("10 Hz", "steps=400"):
        mbd.simulate(block(), 1.0, steps=20, gradients="none", backend="eager")


def test_a_spring_that_nothing_excites_costs_no_steps() -> None:
    assert status(block(where=0.0), 20) == "ok"
    ground, pendulum = mbd.Ground(), mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01), position=(1.0, 0.0, 0.0))
    hinge = mbd.Revolute(ground.at(), pendulum.at(-1.0, 0.0, 0.0), axis="z")
    body = mbd.RigidBody("block", 1.0, (0.1, 0.1, 0.1))
    slide = mbd.Prismatic(ground.at(), body.at(), axis="x")
    stiff = mbd.AxialSpringDamper(ground.at(), body.at(), "x", stiffness=1e6)
    assert status(mbd.System([pendulum, body], [hinge, slide], [stiff], gravity=(0.0, -9.81, 0.0)), 100) == "ok"


@pytest.mark.parametrize("change", [{"release": ["extra"]}, {"lock": ["extra"]}])
def test_phases_change_nothing(change) -> None:
    system = block()
    other = mbd.RigidBody("other", 1.0, (0.1, 0.1, 0.1), position=(0.0, 1.0, 0.0))
    extra = mbd.Prismatic(mbd.Ground().at(0.0, 1.0, 0.0), other.at(), axis="x", name="extra")
    both = mbd.System([*system.bodies, other], [*system.joints, extra], system.forces)
    phases = [mbd.Phase(until=0.3, **change), mbd.Phase()]
    assert "10 Hz" in status(both, 20, phases=phases)
    assert status(both, 160, phases=phases) == "ok"


@pytest.mark.parametrize("turns", [False, True])
def test_steps_that_are_chosen_resolve_a_vibration(turns, monkeypatch) -> None:
    """Also where the first steps, five in a period, do not show its frequency."""
    monkeypatch.setattr("torchmbd.integrate.step_count.RIGID", 50)
    motion = mbd.simulate(block(turns=turns), 1.0, gradients="none")
    assert motion.status == ["ok"]
    assert motion.stats["steps"] > 40 * FREQUENCY
