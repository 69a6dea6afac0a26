"""Contact against closed forms: a bouncing mass, restitution, a slider between stops, a block that slides to rest."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd

pytestmark = pytest.mark.usefixtures("compiled")
GROUND = mbd.Ground()
G, K, MASS, HEIGHT = 9.81, 2e4, 0.7, 0.1


def ball(
    height: float = HEIGHT, speed: float = 0.0, mass: float = MASS, gravity: bool = True, **given: object
) -> mbd.System:
    body = mbd.RigidBody("ball", mass, (0.01,) * 3, position=(0.0, 0.0, height), velocity=(0.0, 0.0, -speed))
    floor = mbd.PlaneContact(GROUND.at(), body.at(), name="floor", **({"stiffness": K} | given))
    return mbd.System([body], forces=[floor], gravity=(0.0, 0.0, -G) if gravity else None, free=["ball"])


def height_after(k: Tensor, m: Tensor, h: Tensor, t: float, bounces: int) -> Tensor:
    """Height [m] at a time of the flight after so many bounces on a linear spring; no energy is lost."""
    v, w = (2.0 * G * h).sqrt(), (k / m).sqrt()
    contact = 2.0 / w * (math.pi - torch.atan(v * w / G))
    since = t - v / G - contact - (bounces - 1) * (2.0 * v / G + contact)
    return v * since - 0.5 * G * since * since


def numbers(*x: float) -> list[Tensor]:
    return [torch.tensor(y, dtype=torch.float64, requires_grad=True) for y in x]


@pytest.mark.thorough
def test_bounces_come_back_in_time_and_height():
    k, m, h = numbers(K, MASS, HEIGHT)
    fall, w = (2.0 * h / G).sqrt(), (k / m).sqrt()
    period = float(2.0 * fall + 2.0 / w * (math.pi - torch.atan(fall * w)))
    errors = []
    for steps in (2000, 4000):  # 42 and 84 in a contact
        motion = mbd.simulate(ball(), 5.0 * period, steps=steps, gradients="none").require_ok()
        z = motion.q[0, :: steps // 5, 2]
        assert_close(z, torch.full_like(z, HEIGHT), rtol=0, atol=1e-3 * HEIGHT)  # where a step meets the floor
        total = motion.energies.stored + 0.0
        flying = motion.q[0, :, 2] > 0.0
        errors.append(float((total[0, flying] / (MASS * G * HEIGHT) - 1.0).abs().max()))
    assert max(errors) < 1e-3


@pytest.mark.thorough
def test_gradients_of_the_height_after_a_bounce():
    """By stiffness, mass and drop height: differences of the same steps, and the closed form to first order of the step.

    The instant of contact lies somewhere in a step: with 240 steps in contact the derivatives are 1.5 to 6 % off.
    """
    values = torch.tensor([K, MASS, HEIGHT], dtype=torch.float64)
    at = 0.18
    body = mbd.RigidBody(
        "ball",
        torch.nn.Parameter(values[1].clone()),
        (0.01,) * 3,
        position=torch.nn.Parameter(torch.tensor([0.0, 0.0, HEIGHT], dtype=torch.float64)),
    )
    floor = mbd.PlaneContact(GROUND.at(), body.at(), stiffness=mbd.variable(K), name="floor")
    system = mbd.System([body], forces=[floor], gravity=(0.0, 0.0, -G), free=["ball"])

    def final(x: Tensor) -> Tensor:
        position = torch.nn.functional.pad(x[:, 2:], (2, 0))
        designs = {"floor.stiffness": x[:, 0], "ball.mass": x[:, 1], "ball.position": position}
        return mbd.simulate(system, at, steps=2400, designs=designs, iterations=(4, 3)).require_ok().q[:, -1, 2]

    x = values[None].clone().requires_grad_()
    z = final(x)
    [result] = torch.autograd.grad(z.sum(), x)
    k, m, h = numbers(*values.tolist())
    exact = height_after(k, m, h, at, 1)
    assert float(z) == pytest.approx(float(exact), rel=2e-5)
    expected = torch.stack(torch.autograd.grad(exact, [k, m, h]))
    assert_close(result[0] * values, expected * values, rtol=0, atol=0.05 * float((expected * values).abs().max()))
    d = 1e-6 * values
    both = final(torch.cat([values + torch.diag(d), values - torch.diag(d)])).detach()
    differences = (both[:3] - both[3:]) / (2.0 * d)
    assert_close(result[0] * values, differences * values, rtol=0, atol=1e-6 * float((expected * values).abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize(("exponent", "error"), [(1.5, 4e-3), (2.0, 5e-4)])
def test_gradients_of_a_force_without_a_kink(exponent, error):
    """By drop height after a bounce, 150 steps in contact; with the exponent 1 it is 9 % off (docs/how-to/contact.md)."""
    at, k = 0.18, K / 0.015 ** (exponent - 1.0)

    def height(h: float) -> float:
        v, rise = math.sqrt(2.0 * G * h), lambda t, y: y[0]
        rise.terminal, rise.direction = True, 1.0

        def rates(t: float, y: Sequence[float]) -> list[float]:
            return [y[1], -G + k * max(-y[0], 0.0) ** exponent / MASS]

        result = solve_ivp(rates, (0.0, 1.0), [0.0, -v], "DOP853", rtol=1e-13, atol=1e-15, events=rise)
        since = at - v / G - result.t[-1]
        return result.y[1, -1] * since - 0.5 * G * since**2

    expected = (height(HEIGHT + 1e-6) - height(HEIGHT - 1e-6)) / 2e-6
    start = torch.nn.Parameter(torch.tensor([0.0, 0.0, HEIGHT], dtype=torch.float64))
    body = mbd.RigidBody("ball", MASS, (0.01,) * 3, position=start)
    floor = mbd.PlaneContact(GROUND.at(), body.at(), stiffness=k, exponent=exponent, name="floor")
    system = mbd.System([body], forces=[floor], gravity=(0.0, 0.0, -G), free=["ball"])
    motion = mbd.simulate(system, at, steps=1200, iterations=(4, 3)).require_ok()
    [result] = torch.autograd.grad(motion.q[0, -1, 2], start)
    assert float(result[2]) == pytest.approx(expected, rel=error)


@pytest.mark.thorough
@pytest.mark.parametrize(("exponent", "damping"), [(1.0, 0.3), (1.5, 0.8), (2.0, 0.0), (1.0, 3.0)])
def test_restitution_of_hunt_and_crossley(exponent, damping):
    """Of no mass and no stiffness: from the law without time."""
    v = 1.3
    motion = mbd.simulate(
        ball(0.01, v, gravity=False, exponent=exponent, damping=damping), 0.15, steps=6000, gradients="none"
    ).require_ok()
    result = float(motion.v[0, -1, 2])
    if not damping:
        assert result == pytest.approx(v, rel=1e-6)
        return
    left = damping * v - math.log1p(damping * v)
    w = brentq(lambda w: -damping * w - math.log1p(-damping * w) - left, 1e-9, (1.0 - 1e-9) / damping)
    assert result == pytest.approx(w, rel=2e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("turns", [False, True])
def test_the_period_between_stops(turns):
    clearance, v, inertia, k = 0.24, 1.5, 0.4, 3e4
    moving = {"angular_velocity": (0.0, 0.0, v)} if turns else {"velocity": (v, 0.0, 0.0)}
    body = mbd.RigidBody("slider", 0.4, (0.4, 0.4, inertia), **moving)
    kind, stop, axis = (mbd.Revolute, mbd.RotationalStop, "z") if turns else (mbd.Prismatic, mbd.AxialStop, "x")
    joint = kind(GROUND.at(), body.at(), axis=axis)
    stops = stop(GROUND.at(), body.at(), axis, lower=-0.1, upper=clearance - 0.1, stiffness=k)
    period = 2.0 * clearance / v + 2.0 * math.pi * math.sqrt(inertia / k)
    motion = mbd.simulate(mbd.System([body], [joint], [stops]), 3.0 * period, steps=9000, gradients="none").require_ok()
    at = mbd.Angle("slider", "z")(motion)[0] if turns else motion.q[0, :, 0]
    for i in (3000, 6000, 9000):
        assert float(at[i]) == pytest.approx(0.0, abs=2e-4)
    assert float(at.max()) == pytest.approx(clearance - 0.1 + v * math.sqrt(inertia / k), rel=1e-4)
    assert float(at.min()) == pytest.approx(-0.1 - v * math.sqrt(inertia / k), rel=1e-4)


def sliding(speed: float, slope: float = 0.0, mu: float = 0.3, v: float = 0.8, duration: float = 1.0) -> mbd.Trajectory:
    """A block on a plane, pressed in as far as its weight does."""
    weight = MASS * G * math.cos(slope)
    block = mbd.RigidBody("block", MASS, (0.01,) * 3, position=(0.0, 0.0, -weight / K), velocity=(v, 0.0, 0.0))
    floor = mbd.PlaneContact(GROUND.at(), block.at(), stiffness=K, friction=mu, speed=speed)
    gravity = (G * math.sin(slope), 0.0, -G * math.cos(slope))
    system = mbd.System([block], forces=[floor], gravity=gravity, free=["block"])
    return mbd.simulate(system, duration, steps=1000, gradients="none").require_ok()


@pytest.mark.thorough
def test_the_sliding_distance_to_second_order_of_the_speed_of_friction():
    """v^2 / (2 mu g) + pi^2 u0^2 / (12 mu g) of the regularized law."""
    mu, v = 0.3, 0.8
    missing = []
    for speed in (0.1, 0.05, 0.025):
        distance = float(sliding(speed).q[0, -1, 0])
        assert distance == pytest.approx((v**2 / 2.0 + (math.pi * speed) ** 2 / 12.0) / (mu * G), rel=3e-5)
        missing.append(distance - v**2 / (2.0 * mu * G))
    for coarse, fine in itertools.pairwise(missing):
        assert coarse / fine == pytest.approx(4.0, rel=0.02)


@pytest.mark.thorough
def test_a_block_on_a_slope_stops_up_to_the_stated_creep():
    slope, mu, v, speed = 0.2, 0.4, 0.8, 0.005
    motion = sliding(speed, slope, mu, v)
    braking = G * (mu * math.cos(slope) - math.sin(slope))
    stop = v / braking
    x = motion.q[0, int(stop * 1000.0) + 40, 0]
    creep = speed * math.atanh(math.tan(slope) / mu)
    assert float(motion.v[0, -1, 0]) == pytest.approx(creep, rel=1e-6)
    assert float(x) == pytest.approx(v * v / (2.0 * braking), rel=1e-3)


@pytest.mark.thorough
def test_a_ball_that_slides_begins_to_roll():
    """A full sphere ends with 5/7 of its speed, however rough the plane is; no energy is lost by rolling."""
    r, v, mu = 0.1, 1.0, 0.2
    inertia = 0.4 * MASS * r * r
    body = mbd.RigidBody("ball", MASS, (inertia,) * 3, position=(0.0, 0.0, r - MASS * G / K), velocity=(v, 0.0, 0.0))
    floor = mbd.PlaneContact(GROUND.at(), body.at(), radius=r, stiffness=K, friction=mu, speed=0.002)
    system = mbd.System([body], forces=[floor], gravity=(0.0, 0.0, -G), free=["ball"])
    motion = mbd.simulate(system, 0.4, steps=1000, gradients="none").require_ok()
    sliding_ends = 2.0 * v / (7.0 * mu * G)  # [s], after which it rolls
    assert float(motion.v[0, -1, 0]) == pytest.approx(5.0 / 7.0 * v, rel=1e-4)
    assert float(motion.body("ball").omega[0, -1, 1]) == pytest.approx(5.0 / 7.0 * v / r, rel=1e-4)
    early = int(0.5 * sliding_ends / 0.4 * 1000.0)
    t = early * 4e-4
    assert float(motion.v[0, early, 0]) == pytest.approx(v - mu * G * t, rel=1e-5)
