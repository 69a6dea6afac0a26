"""A pendulum on a spring, with data of another one: what the tests of identification fit."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from torchmbd.design.curve import curve_of

ANGLE, FORCE = mbd.Angle("bob", "z"), mbd.Reaction("hinge", "y")
TRUTH = {"bob.mass": 1.2, "spring.stiffness": 2.0, "spring.damping": 0.15}
UNKNOWNS = list(TRUTH)


def system(mass: float = 1.2, stiffness: float = 2.0, damping: float = 0.15, speed: float = 1.0) -> mbd.System:
    """A bob of fixed inertia on a hinge with a spring and a damper."""
    ground = mbd.Ground()
    inertia = torch.tensor([0.05, 0.05, 0.05], dtype=torch.float64)
    motion = {"position": (0, -1.0, 0), "velocity": (speed, 0, 0), "angular_velocity": (0, 0, speed)}
    bob = mbd.RigidBody("bob", mbd.variable(mass), inertia, **motion)
    hinge = mbd.Revolute(ground.at(), bob.at(0, 1.0, 0), "z", "hinge")
    numbers = {"stiffness": mbd.variable(stiffness), "damping": mbd.variable(damping)}
    spring = mbd.RotationalSpringDamper(ground.at(), bob.at(0, 1.0, 0), "z", name="spring", **numbers)
    return mbd.System([bob], [hinge], [spring], gravity=(0, -9.81, 0))


def shown(response: mbd.History, t: np.ndarray, model: mbd.System | None = None) -> np.ndarray:
    """What a perfect sensor shows at times t of a motion of one second."""
    motion = mbd.simulate(model or system(), 1.0, steps=STEPS, gradients="none")
    curve = curve_of(motion, lambda part, _: (response.values(part), response.rates(part)))
    return curve.at(torch.from_numpy(t))[0].numpy()


STEPS = 40
TIMES = np.linspace(0.05, 0.9, 60)


def data(noise: float = 0.0, seed: int = 0, **changes: Any) -> dict[str, np.ndarray]:
    """Angle and force with noise, as shares of their spread."""
    rng, result = np.random.default_rng(seed), {"t": TIMES}
    for name, response in (("angle", ANGLE), ("force", FORCE)):
        y = shown(response, TIMES)
        result[name] = y + noise * y.std() * rng.standard_normal(len(y))
    return result | changes


def experiment(numbers: dict[str, np.ndarray], start: float = 1.3, **channels: Any) -> mbd.Experiment:
    """An experiment of a model that is off by a factor `start`."""
    model = system(1.2 * start, 2.0 / start, 0.15 * start)
    of_channels = channels or {"angle": mbd.Channel(ANGLE, deviation=1e-3), "force": mbd.Channel(FORCE, deviation=1e-2)}
    return mbd.Experiment(model, mbd.TimeSeries(numbers, of_channels), steps=STEPS, duration=1.0)
