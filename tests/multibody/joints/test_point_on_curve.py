"""Beads on wires: a parabola against the equation of one coordinate, a line, compiled code, gradients, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.integrate
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.refused import refused

GROUND = mbd.Ground()
A, B, G = 1.2, 0.7, 9.81  # y = A x^2, z = B x^3; gravity along -y


def bead(x: float = 0.4, curve: tuple = ((0.0, 0.0, A), (0.0, 0.0, 0.0, B))) -> mbd.System:
    place = (x, *(sum(c * x**k for k, c in enumerate(coefficients)) for coefficients in curve))
    ball = mbd.RigidBody("bead", mbd.variable(0.2), (1e-3, 1e-3, 1e-3), position=place)
    wire = mbd.PointOnCurve(GROUND.at(), ball.at(), *curve, name="wire")
    return mbd.System([ball], [wire], gravity=(0.0, -G, 0.0))


def reduced(times: np.ndarray, x: float) -> np.ndarray:
    """x [t], x' [t] of (1 + y'^2 + z'^2) x'' + (y' y'' + z' z'') x'^2 + g y' = 0, to 1e-12."""

    def rates(_: float, state: np.ndarray) -> list[float]:
        x, v = state
        y1, y2, z1, z2 = 2.0 * A * x, 2.0 * A, 3.0 * B * x**2, 6.0 * B * x
        return [v, -((y1 * y2 + z1 * z2) * v**2 + G * y1) / (1.0 + y1**2 + z1**2)]

    options: dict = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    return scipy.integrate.solve_ivp(rates, (0.0, times[-1]), [x, 0.0], t_eval=times, **options).y


@pytest.mark.thorough
def test_a_bead_on_a_curve_in_space_moves_as_its_one_coordinate():
    """By the index-1 equations to 1e-8; the force of the wire is across it, and the bead does not turn."""
    times = np.linspace(0.0, 0.3, 7)
    options: dict = {"method": "dopri5", "rtol": 1e-9, "atol": 1e-10}
    motion = mbd.simulate(bead(), 0.3, steps=6, **options).require_ok()
    x, v = reduced(times, 0.4)
    assert_close(motion.body("bead").r[0, :, 0], torch.from_numpy(x), rtol=0, atol=1e-8)
    assert_close(motion.body("bead").r[0, :, 2], torch.from_numpy(B * x**3), rtol=0, atol=1e-8)
    tangent = torch.from_numpy(np.stack([np.ones_like(x), 2.0 * A * x, 3.0 * B * x**2], 1))
    force = motion.reaction("wire").force[0]
    assert float(((force * tangent).sum(1) / force.norm(dim=1)).abs().max()) < 1e-8
    assert float(motion.body("bead").omega.abs().max()) < 1e-12
    assert float(np.abs(v).max()) > 1.2


@pytest.mark.parametrize("backend", ["eager", "native"])
def test_steps_of_generalized_alpha_converge_to_it(backend):
    """Errors of a fourth with half the step."""
    errors = []
    for steps in (100, 200):
        motion = mbd.simulate(bead(), 1.0, steps=steps, backend=backend).require_ok()
        x = reduced(np.array([0.0, 1.0]), 0.4)[0, -1]
        errors.append(abs(float(motion.body("bead").r[0, -1, 0].detach()) - x))
    assert errors[1] < 5e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_small_vibrations_at_the_bottom():
    """f = sqrt(2 A g) / (2 pi); the bead turns freely."""
    system = bead(0.0, ((0.0, 0.0, A), (0.0,)))
    frequencies = mbd.equilibrium(system).vibrations[0].frequencies
    assert float(frequencies[-1]) == pytest.approx(math.sqrt(2.0 * A * G) / (2.0 * math.pi), rel=1e-9)
    assert len(frequencies) == 4


def test_gradients_forward_and_reverse():
    """A bead on a wire ends at a spring. Its final place is differentiated by its mass."""

    def place(mass: torch.Tensor) -> torch.Tensor:
        options: dict = {"backend": "eager", "iterations": (8, 8), "refresh": 1}
        motion = mbd.simulate(SPRING, 0.3, steps=60, designs={"bead.mass": mass}, **options)
        return motion.body("bead").r[0, -1]

    mass = tensor(0.2)[0]
    reverse, forward = torch.func.jacrev(place)(mass), torch.func.jacfwd(place)(mass)
    assert float(forward.abs().max()) > 1e-2
    assert_close(reverse, forward, rtol=1e-9, atol=1e-12)
    h = 1e-4
    difference = (place(mass + h) - place(mass - h)) / (2.0 * h)
    assert_close(forward, difference, rtol=1e-5, atol=1e-7)


def _with_spring() -> mbd.System:
    system = bead()
    ball, wire = system.body("bead"), system.joints[0]
    spring = mbd.SpringDamper(GROUND.at(-0.5, 0.2, 0.1), ball.at(), stiffness=3.0, damping=0.1)
    return mbd.System([ball], [wire], [spring], gravity=(0.0, -G, 0.0))


SPRING = _with_spring()


def test_bad_curves_are_named():
    ball = mbd.RigidBody("bead", 0.2, (1e-3, 1e-3, 1e-3))
    for given, path in (
        ({"first": []}, "wire.first"),
        ({"first": [0.0] * 7}, "wire.first"),
        ({"first": [0.0], "second": [float("nan")]}, "wire.second"),
        ({"first": 1.0}, "wire.first"),
        ({"first": [0.0], "axis": "w"}, "axis"),
    ):
        arguments: dict = {"name": "wire"} | given
        with refused(path):
            mbd.PointOnCurve(GROUND.at(), ball.at(), **arguments)
