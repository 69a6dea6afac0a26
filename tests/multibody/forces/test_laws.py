"""Laws against their own definition, and small systems against closed forms."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, tensor
from tests.refused import ANY, refused
from torchmbd.multibody.forces import Gap, Pieces, Table

pytestmark = pytest.mark.usefixtures("compiled")


def at(law, s: float, rate: float = 0.0) -> float:
    return float(law(tensor(s), tensor(rate), tensor(0.0)[0]))


def test_a_table_passes_through_its_knots():
    law = Table(((-1.0, 2.0), (0.5, -1.0), (2.0, 4.0)), damping=0.3)
    for s, f in law.knots:
        assert at(law, s) == pytest.approx(f)
    assert at(law, -7.0) == 2.0
    assert at(law, 9.0) == pytest.approx(4.0)
    assert at(law, -0.25) == pytest.approx(0.5)
    assert at(law, 0.5, 2.0) == pytest.approx(-1.6)


def test_pieces_are_what_they_say_away_from_their_borders():
    law = Pieces((0.0, 1.0), (1.0, -0.5, 2.0), (0.3, -1.0, 0.7), width=0.05)
    for s, f in ((-0.5, 1.0 - 0.15), (0.5, -0.5 - 0.5), (1.5, 2.0 + 1.05)):
        assert at(law, s) == pytest.approx(f)
    assert at(law, 0.0) == pytest.approx(0.25)  # half way between 1 and -0.5


def test_a_stop_pushes_one_way_only():
    above, below = Gap(100.0, limit=0.2, sign=-1.0, damping=1.0), Gap(100.0, limit=0.2, damping=1.0)
    assert at(above, 0.1, 3.0) == 0.0
    assert at(above, 0.3, 3.0) == pytest.approx(-13.0)
    assert at(below, 0.3, 3.0) == 0.0
    assert at(below, 0.1) == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Table(((0.0, 1.0), (0.0, 2.0))), ("knots", ((0.0, 1.0), (0.0, 2.0)), "growing")),
        (lambda: Pieces((0.0,), (1.0,), (1.0, 2.0), 0.1), ("borders", ANY, "borders are 1", "1 intercepts")),
        (lambda: Pieces((0.0, 0.1), (1.0,) * 3, (0.0,) * 3, 0.1), ("borders", (0.0, 0.1), "apart")),
        (lambda: Gap(1.0, sign=0.5), ("sign", 0.5)),
    ],
)
def test_bad_laws_are_named(make, said):
    with refused(*said):
        make()


def test_bad_elements_are_named():
    a, b, ground = box("a"), box("b"), mbd.Ground()
    wrong: list[tuple[Any, tuple[Any, ...]]] = [
        (lambda: mbd.SpringDamper(a.at(), b.at()), ("springdamper_a_b", ANY, "neither law nor stiffness")),
        (lambda: mbd.SpringDamper(a.at(), a.at(), stiffness=1.0), ("b", ANY, "two different bodies")),
        (lambda: mbd.SpringDamper(a, b.at(), stiffness=1.0), ("a", ANY, "frames")),
        (
            lambda: mbd.SpringDamper(a.at(), b.at(), law=lambda s, r, t: s / 0.0 * 0.0),
            ("springdamper_a_b.law", ANY, "finite"),
        ),
        (lambda: mbd.Force(ground.at(), (1.0, 0.0, 0.0)), ("frame", ANY, "at least one frame on a body")),
        (lambda: mbd.Force(a.at(), (1.0, math.nan, 0.0)), ("force_a.vector", ANY, "three finite numbers")),
        (lambda: mbd.Torque(a.at(), (1.0, 0.0, 0.0), axes="body"), ("torque_a.axes", "body", "'ground' or 'frame'")),
        (
            lambda: mbd.System([a], forces=[mbd.SpringDamper(a.at(), b.at(), stiffness=1.0)]),
            ("forces.springdamper_a_b", ANY, "body 'b'", "not among"),
        ),
    ]
    for make, said in wrong:
        with refused(*said):
            make()


def oscillator(x, rate, k, c, m, t):
    d = 0.5 * c / m
    w = math.sqrt(k / m - d * d)
    return torch.exp(-d * t) * (x * torch.cos(w * t) + (rate + d * x) / w * torch.sin(w * t))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [mbd.SpringDamper, mbd.AxialSpringDamper])
def test_a_mass_on_a_spring(kind):
    ground = mbd.Ground()
    body = mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0), position=(1.2, 0.0, 0.0))
    spring = kind(ground.at(), body.at(), stiffness=50.0, damping=1.5, rest=1.0)
    motion = mbd.simulate(
        mbd.System([body], [mbd.Prismatic(ground.at(), body.at(), axis="x")], [spring]), 2.0, steps=400
    )
    expected = 1.0 + oscillator(0.2, 0.0, 50.0, 1.5, 2.0, motion.t)
    assert_close(motion.body("mass").r[0, :, 0], expected, rtol=0, atol=1e-4)


@pytest.mark.thorough
def test_a_wheel_on_a_torsion_spring():
    ground, wheel = mbd.Ground(), mbd.RigidBody("wheel", 2.0, (1.0, 1.0, 0.3), angular_velocity=(0.0, 0.0, 2.0))
    spring = mbd.RotationalSpringDamper(ground.at(), wheel.at(), stiffness=4.0, damping=0.2)
    motion = mbd.simulate(mbd.System([wheel], [mbd.Revolute(ground.at(), wheel.at())], [spring]), 2.0, steps=400)
    A = motion.body("wheel").A[0]
    angle = torch.atan2(A[:, 1, 0], A[:, 0, 0])
    assert_close(angle, oscillator(0.0, 2.0, 4.0, 0.2, 0.3, motion.t), rtol=0, atol=3e-4)


@pytest.mark.thorough
def test_loads_in_both_axes():
    """A force in ground axes moves the center straight on; one that follows the body turns with it."""
    load = (0.4, -0.3, 0.2)
    body = mbd.RigidBody("block", 0.5, (0.1, 0.1, 0.1), angular_velocity=(0.0, 0.0, 3.0))
    still = mbd.simulate(mbd.System([body], forces=[mbd.Force(body.at(), load)]), 1.0, steps=400)
    expected = 0.5 * torch.tensor(load, dtype=torch.float64) / 0.5 * still.t[:, None] ** 2
    assert_close(still.body("block").r[0], expected, rtol=0, atol=1e-9)
    turning = mbd.simulate(mbd.System([body], forces=[mbd.Force(body.at(), (1.5, 0, 0), axes="frame")]), 1.0, steps=800)
    w, t = 3.0, turning.t
    x = 3.0 / w**2 * (1.0 - torch.cos(w * t))
    y = 3.0 / w**2 * (w * t - torch.sin(w * t))
    assert_close(turning.body("block").r[0, :, :2], torch.stack([x, y], 1), rtol=0, atol=1e-4)


@pytest.mark.thorough
def test_a_torque_that_grows_with_time():
    body = mbd.RigidBody("block", 0.5, (0.3, 0.2, 0.4))
    law = lambda t: torch.stack([0.0 * t, 0.0 * t, 0.8 * t])  # noqa: E731
    motion = mbd.simulate(mbd.System([body], forces=[mbd.Torque(body.at(), law)]), 1.0, steps=200)
    assert_close(motion.body("block").omega[0, :, 2], motion.t**2, rtol=0, atol=3e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4", "dopri5"])
def test_a_law_that_ceases_to_be_finite_is_named(method):
    """A root of a length that is used up: the motion ends there, and says whose law it was."""
    ground, body = mbd.Ground(), mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    fine = mbd.AxialSpringDamper(ground.at(), body.at(), stiffness=3.0, name="spring")
    law = mbd.AxialSpringDamper(ground.at(), body.at(), law=lambda s, r, t: torch.sqrt(0.2 - s), name="valve")
    system = mbd.System([body], [mbd.Prismatic(ground.at(), body.at(), axis="x")], [fine, law])
    motion = mbd.simulate(system, 1.0, method, steps=50)
    assert motion.status[0].startswith("failed: ")
    if method != "dopri5":  # which has no states to look at once its steps underflow
        assert "the law of 'valve' is not finite near s = 0.1" in motion.status[0]
    assert "spring" not in motion.status[0]
