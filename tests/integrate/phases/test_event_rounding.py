"""Functions that are zero but for rounding end no phase; those that reach zero and stay there end it where they reach it.

A pendulum swings in a plane that is turned out of all axes: positions, rates, accelerations, forces and torques across this
plane are rounding. Its fall from the level through an angle is an elliptic integral.
"""

from __future__ import annotations

import math

import pytest
import torch
from scipy.integrate import quad
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import turned

G, LENGTH = 9.81, 0.3
PLANE = turned(0.3, 0.5, 0.7)
ACROSS = tuple(PLANE[:, 1].tolist())


def pendulum(origin: tuple = (0.0, 0.0, 0.0), unit: float = 1.0, angle: float = 0.0) -> mbd.System:
    """A body on a hinge across the plane, at an angle below the level; lengths are in `unit` meters, the mass is a variable."""
    at = torch.tensor(origin, dtype=torch.float64) / unit
    axes = turned(*(angle * PLANE[:, 1]).tolist()) @ PLANE
    inertia = tuple(3 * [0.01 / unit**2])
    place = tuple((at + axes[:, 0] * LENGTH / unit).tolist())
    arm = mbd.RigidBody("arm", mbd.variable(1.0), inertia, position=place, axes=axes)
    ground = mbd.Ground().at(*at.tolist(), axes=axes)
    hinge = mbd.Revolute(ground, arm.at(-LENGTH / unit, 0, 0), axis="y", name="hinge")
    return mbd.System([arm], [hinge], gravity=tuple((PLANE[:, 2] * -G / unit).tolist()))


ZERO = {
    "velocity": mbd.Velocity("arm", ACROSS),
    "acceleration": lambda motion: motion.body("arm").at().acceleration @ PLANE[:, 1],
    "force": mbd.Reaction("hinge", ACROSS),
    "torque": mbd.Reaction("hinge", tuple(PLANE[:, 0].tolist()), kind="torque"),
    "rotation": lambda motion: (motion.body("arm").A.mT @ motion.body("arm").A)[..., 0, 0] - 1.0,
}
PLACES: dict[str, dict] = {"here": {}, "far": {"origin": (1000.0, -700.0, 300.0)}, "millimeters": {"unit": 1e-3}}


def origin_of(place: str) -> Tensor:
    return torch.tensor(PLACES[place].get("origin", (0.0, 0.0, 0.0)), dtype=torch.float64)


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("function", ["position", *ZERO])
@pytest.mark.parametrize("steps", [40, 57])
def test_a_function_that_is_rounding_ends_no_phase(function, place, steps):
    level = origin_of(place) @ PLANE[:, 1] / PLACES[place].get("unit", 1.0)
    event = mbd.Event(ZERO.get(function, lambda motion: motion.body("arm").r @ PLANE[:, 1] - level))
    phases = [mbd.Phase(until=event, name="swing"), mbd.Phase()]
    options = {"phases": phases, "gradients": "none", "backend": "eager"}
    motion = mbd.simulate(pendulum(**PLACES[place]), 0.4, steps=steps, **options)
    assert "phase 'swing' never ends: its event does not occur" in motion.status[0]


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_a_small_motion_is_an_event_wherever_the_machine_is(place):
    """A pendulum that hangs but for a hundred thousandth of a radian passes its rest after a quarter of its period."""
    unit = PLACES[place].get("unit", 1.0)
    system = pendulum(**PLACES[place], angle=0.5 * math.pi - 1e-5)
    event = mbd.Event(lambda motion: (motion.body("arm").r - origin_of(place) / unit) @ PLANE[:, 0])
    phases = [mbd.Phase(until=event), mbd.Phase()]
    motion = mbd.simulate(system, 0.5, steps=100, phases=phases, gradients="none", backend="eager").require_ok()
    quarter = 0.5 * math.pi * math.sqrt((LENGTH**2 + 0.01) / (G * LENGTH))
    assert motion.switches[0].t.item() == pytest.approx(quarter, rel=1e-3)


DROP = 0.1  # [m]


def time_of_the_drop() -> float:
    """The integral of the slowness of the pendulum from the level until it is DROP below, with angle = s^2."""
    end = math.asin(DROP / LENGTH)
    square = 2.0 * G * LENGTH / (LENGTH**2 + 0.01)  # of the rate, times the sine of the angle

    def slowness(s: float) -> float:
        return 2.0 * s / math.sqrt(square * math.sin(s * s)) if s else 2.0 / math.sqrt(square)

    return quad(slowness, 0.0, math.sqrt(end), epsabs=1e-13)[0]


def depth(motion: mbd.Trajectory) -> Tensor:
    return motion.body("arm").r @ PLANE[:, 2] + DROP


FLAT = {
    "relu": lambda motion: torch.relu(depth(motion)),
    "clamp": lambda motion: depth(motion).clamp(0.0, 0.02),
    "negative": lambda motion: -depth(motion).clamp_min(0.0),
    "dead zone": lambda motion: torch.relu(depth(motion)) - torch.relu(-0.01 - depth(motion)),
}


@pytest.mark.thorough
@pytest.mark.parametrize("function", FLAT)
@pytest.mark.parametrize("gradients", ["none", "forward", "reverse"])
def test_a_function_that_reaches_zero_and_stays_there(function, gradients):
    """Its time and the derivative are those of the depth itself, whatever follows."""
    times, slopes = [], []
    for f in (depth, FLAT[function]):
        phases = [mbd.Phase(until=mbd.Event(f)), mbd.Phase()]
        options = {"phases": phases, "gradients": gradients, "backend": "eager"}
        motion = mbd.simulate(pendulum(), 0.4, steps=40, **options).require_ok()
        times.append(motion.switches[0].t.detach())
        if gradients == "forward":
            slopes.append(motion.switches[0].dt_db)
        elif gradients == "reverse":
            slopes.append(torch.autograd.grad(motion.switches[0].t.sum(), list(motion.variables.values()))[0])
    assert times[1].item() == pytest.approx(time_of_the_drop(), rel=2e-3)
    assert_close(times[1], times[0], rtol=0, atol=1e-11)
    if slopes:
        assert_close(slopes[1], slopes[0], rtol=1e-6, atol=1e-9)
