"""Linearization along a motion: pendulums in joint angles, and perturbed motions of mechanisms in general position."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum, rigid_pendulum, tensor
from tests.refused import refused
from torchmbd.extensions.vibrations.moving_state import MovingLinearization, _accelerations

G, GROUND = 9.81, mbd.Ground()


def at_angles(angles: Tensor, rates: Tensor, lengths: tuple[float, ...], masses: tuple[float, ...], speed: float = 0.0):
    """A chain of point masses at absolute angles from -y, with its state; `speed`: of the hinge's rail along x."""
    bodies, x, y, q, v = [], 0.0, 0.0, [], []
    inertia, vx, vy = 1e-2, speed, 0.0
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        bodies.append(mbd.RigidBody(f"mass{i}", mass, (inertia,) * 3, position=(0, -sum(lengths[: i + 1]), 0)))
        s, c = math.sin(angles[i]), math.cos(angles[i])
        x, y = x + length * s, y - length * c
        vx, vy = vx + length * c * float(rates[i]), vy + length * s * float(rates[i])
        q.append([x, y, 0.0, math.cos(angles[i] / 2), 0.0, 0.0, math.sin(angles[i] / 2)])
        v.append([vx, vy, 0.0, 0.0, 0.0, float(rates[i])])
    return bodies, (torch.tensor(x, dtype=torch.float64).T.reshape(-1, 1, 1) for x in (q, v)), inertia


def test_a_swinging_pendulum_in_closed_form():
    """(m L^2 + J) angle'' = -m g L sin(angle): any rate, in the angle."""
    L, m = 2.0, 1.5
    [bob], (q, v), J = at_angles(tensor(0.8), tensor(-2.5), (L,), (m,))
    system = mbd.System([bob], [mbd.Revolute(GROUND.at(), bob.at(0, L, 0), axis="z")], gravity=(0, -G, 0))
    rest = MovingLinearization.of(system.dynamics().values(), q, v, q.new_zeros(()))
    stiffness = m * G * L / (m * L * L + J)
    assert_close(rest.A, tensor(0.0, 1.0, -stiffness * math.cos(0.8), 0.0).reshape(2, 2), rtol=1e-12, atol=1e-12)
    assert max(rest.violation) < 1e-14


def test_a_double_pendulum_in_its_angles():
    """Against derivatives of Lagrange's equations in the absolute angles."""
    (L1, L2), (m1, m2) = (1.1, 0.7), (0.9, 1.4)
    angles, rates = tensor(0.8, -1.3), tensor(-2.5, 4.0)
    bodies, (q, v), J = at_angles(angles, rates, (L1, L2), (m1, m2))
    joints = [
        mbd.Revolute(GROUND.at(), bodies[0].at(0, L1, 0), axis="z"),
        mbd.Revolute(bodies[0].at(), bodies[1].at(0, L2, 0), axis="z"),
    ]
    system = mbd.System(bodies, joints, gravity=(0, -G, 0))
    rest = MovingLinearization.of(system.dynamics().values(), q, v, q.new_zeros(()))

    def accelerations(angles: Tensor, rates: Tensor) -> Tensor:
        turn = angles[0] - angles[1]
        c, s = m2 * L1 * L2 * torch.cos(turn), m2 * L1 * L2 * torch.sin(turn)
        M = torch.stack([c * 0.0 + (m1 + m2) * L1**2 + J, c, c, c * 0.0 + m2 * L2**2 + J]).reshape(2, 2)
        weight = torch.stack([(m1 + m2) * G * L1 * torch.sin(angles[0]), m2 * G * L2 * torch.sin(angles[1])])
        return -torch.linalg.solve(M, weight + torch.stack([s * rates[1] ** 2, -s * rates[0] ** 2]))

    by_angles, by_rates = torch.func.jacrev(accelerations, (0, 1))(angles, rates)
    assert_close(rest.A[2:], torch.cat([by_angles, by_rates], 1), rtol=1e-11, atol=1e-11)


def test_under_a_drive_and_in_coordinates_that_are_chosen():
    """On a carriage at X = sin(w t) / 2: (m L^2 + J) angle'' = -m L (g sin(angle) + X'' cos(angle)), and in L sin(angle)."""
    L, m, t, angle, rate, w = 2.0, 1.5, 0.4, 0.7, 1.9, 3.0
    x, speed, push = (0.5 * f for f in (math.sin(w * t), w * math.cos(w * t), -w * w * math.sin(w * t)))
    [bob], (q, v), J = at_angles(tensor(angle), tensor(rate), (L,), (m,), speed)
    carriage = mbd.RigidBody("carriage", 3.0, (1.0, 1.0, 1.0))
    joints = [
        mbd.Prismatic(GROUND.at(), carriage.at(), axis="x"),
        mbd.Drive(GROUND, carriage, axis="x", position=mbd.Sine(0.5, w / (2.0 * math.pi))),
        mbd.Revolute(carriage.at(), bob.at(0, L, 0), axis="z"),
    ]
    system = mbd.System([carriage, bob], joints, gravity=(0, -G, 0))
    q, v = q[:, 0, 0], v[:, 0, 0]
    both_q = torch.stack([tensor(x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), q + x * tensor(1.0, *[0.0] * 6)], 1)
    both_v = torch.stack([tensor(speed, *[0.0] * 5), v], 1)
    state = system.dynamics().values(), both_q.reshape(-1, 1, 1), both_v.reshape(-1, 1, 1), tensor(t)[0]
    inertia, c, s = m * L * L + J, math.cos(angle), math.sin(angle)
    k = m * L * (G * c - push * s) / inertia
    rest = MovingLinearization.of(*state)
    assert_close(rest.A[1], tensor(-k, 0.0), rtol=1e-12, atol=1e-12)
    turning = -m * L * (G * s + push * c) / inertia
    b, b1, b2 = L * c, -L * s * rate, -L * c * rate**2 - L * s * turning
    across = MovingLinearization.of(*state, coordinates=["displacement x of 'mass0'"])
    assert_close(across.A[1], tensor(b2 / b - 2.0 * (b1 / b) ** 2 - k, 2.0 * b1 / b), rtol=1e-11, atol=1e-11)
    with refused("coordinates"):
        MovingLinearization.of(*state, coordinates=["displacement x of 'carriage'"])
    with refused("coordinates", "angle"):
        MovingLinearization.of(*state, coordinates=["angle"])


def test_a_stiffness_that_cancels_has_derivatives():
    """In L sin(angle) the stiffness vanishes at a rate w, A = -w^2 (1 + 2 tan^2) + k (sin tan - cos), but not dA/dw."""
    L, m, angle = 2.0, 1.5, 1.2
    [bob], (q, v), J = at_angles(tensor(angle), tensor(1.0), (L,), (m,))
    system = mbd.System([bob], [mbd.Revolute(GROUND.at(), bob.at(0, L, 0), axis="z")], gravity=(0, -G, 0))
    k, s, c = m * G * L / (m * L * L + J), math.sin(angle), math.cos(angle)
    steep = 1.0 + 2.0 * (s / c) ** 2
    w = tensor(math.sqrt(k * (s * s / c - c) / steep)).requires_grad_()
    state = system.dynamics().values(), q, w * v, q.new_zeros(())
    K = MovingLinearization.of(*state, coordinates=["displacement x of 'mass0'"]).A[1, 0]
    assert K.item() == 0.0
    assert torch.autograd.grad(K, w)[0].item() == pytest.approx(-2.0 * w.item() * steep, rel=1e-11)


@pytest.mark.parametrize("build", [rigid_pendulum, pendulum])
def test_perturbed_states_in_general_position(build):
    """Differences of accelerations of states that keep the constraints to first order; with a flexible body."""
    system = build()
    motion = mbd.simulate(system, 0.02, steps=20)
    dynamics, t = motion.detach().dynamics.values(), motion.t[-1]
    q, v = (x[0, -1, :, None, None].detach() for x in (motion.q, motion.v))
    rest = MovingLinearization.of(dynamics, q, v, t)
    n, T = len(rest.rows), system.topology
    assert n == {"rigid_pendulum": 4, "pendulum": 5}[build.__name__]
    make = torch.Generator().manual_seed(3)
    z, zd = torch.randn(2, n, generator=make, dtype=torch.float64)
    x, xd = rest.N @ z, rest.N @ zd + rest.N1 @ z
    h, sides = 1e-5, []
    for sign in (-1.0, 1.0):
        near, rates, _ = rest.observer.perturbed(T, q, *(sign * h * y[:, None, None] for y in (x, xd, 0.0 * x)))
        sides.append(_accelerations(dynamics, near, rates, t)[0])
    change = ((sides[1] - sides[0]) / (2.0 * h))[:, 0, 0]
    gyroscopic = rest.observer.perturbed(T, q, *(y[:, None, None] for y in (x, xd, 0.0 * x)))[2] - rest.observer.a
    second = change - gyroscopic[:, 0, 0]
    assert_close(second[rest.rows], rest.A[n:] @ torch.cat([z, zd]), rtol=1e-6, atol=1e-6 * float(second.abs().max()))


def test_coordinates_are_modes_then_rotations_then_displacements():
    motion = mbd.simulate(pendulum(), 0.01, steps=10)
    q, v = (x[0, -1, :, None, None].detach() for x in (motion.q, motion.v))
    dynamics = motion.detach().dynamics.values()
    rows = MovingLinearization.of(dynamics, q, v, motion.t[-1]).rows
    names = [dynamics.topology.rate_name(row) for row in rows]
    assert [name.split()[0] for name in names] == ["rotation"] * 3 + ["mode"] * 2
    assert names[3:] == ["mode 1 of 'rod'", "mode 2 of 'rod'"]
