"""A pendulum on a spring, with data of another one, and a row of masses: what the tests of identification fit."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.linalg import eigh

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


def experiment(numbers: dict[str, np.ndarray], start: float = 1.3, **channels: Any) -> mbd.identification.Experiment:
    """An experiment of a model that is off by a factor `start`."""
    model = system(1.2 * start, 2.0 / start, 0.15 * start)
    of_channels = channels or {
        "angle": mbd.identification.Channel(ANGLE, deviation=1e-3),
        "force": mbd.identification.Channel(FORCE, deviation=1e-2),
    }
    return mbd.identification.Experiment(
        model, mbd.identification.TimeSeries(numbers, of_channels), steps=STEPS, duration=1.0
    )


def pushed(stiffness: float = 2.0) -> mbd.System:
    """The pendulum at rest, with a force on its bob that is a parameter, "push.x"."""
    model = system(stiffness=stiffness, speed=0.0)
    [bob] = model.bodies
    push = mbd.Force(bob.at(), (mbd.variable(0.0), 0.0, 0.0), name="push")
    return mbd.System(model.bodies, model.joints, [*model.forces, push], gravity=(0, -9.81, 0))


def row(k1: float = 8e3, k2: float = 5e3, c1: float = 6.0, c2: float = 3.0) -> mbd.System:
    """Two masses on a line: ground - spring "first" - a (2 kg) - spring "second" - b (1 kg)."""
    ground, bodies, joints, forces = mbd.Ground(), [], [], []
    before, at = ground.at(), 0.0
    for name, mass, k, c in (("a", 2.0, k1, c1), ("b", 1.0, k2, c2)):
        at += 0.5
        body = mbd.RigidBody(name, mass, torch.full((3,), 0.01, dtype=torch.float64), position=(at, 0, 0))
        joints.append(mbd.Prismatic(ground.at(), body.at(), axis="x"))
        label = "first" if name == "a" else "second"
        forces.append(
            mbd.SpringDamper(
                before, body.at(), stiffness=mbd.variable(k), damping=mbd.variable(c), rest=0.5, name=label
            )
        )
        before = body.at()
        bodies.append(body)
    return mbd.System(bodies, joints, forces)


ROW_UNKNOWNS = ["first.stiffness", "second.stiffness", "first.damping", "second.damping"]
ROW_SENSORS = [mbd.Position("a", "x"), mbd.Position("b", "x")]


def row_modes(
    k1: float = 8e3, k2: float = 5e3, c1: float = 6.0, c2: float = 3.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Natural frequencies [Hz], damping ratios and shapes of the row, of its matrices."""
    M = np.diag([2.0, 1.0])
    K, C = (np.array([[x + y, -y], [-y, y]]) for x, y in ((k1, k2), (c1, c2)))
    squares, shapes = eigh(K, M)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    s = np.linalg.eigvals(A)
    s = s[s.imag > 0.0]
    s = s[np.argsort(s.imag)]
    return np.sqrt(squares) / (2.0 * np.pi), -s.real / np.abs(s), shapes
