"""Matrices for control: closed forms, differences of the equations of motion, and the poles of the same state."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import rigid_pendulum
from tests.multibody.equilibrium.test_ground_observer import rotor
from tests.refused import refused
from torchmbd.math.rotation import rotation_matrix

GROUND = mbd.Ground()


def carriage() -> tuple[mbd.System, list[mbd.Prismatic]]:
    """Two masses, 2 kg and 1 kg, on a rail between springs."""
    bodies = [mbd.RigidBody(name, m, (1.0, 1.0, 1.0)) for name, m in (("first", 2.0), ("second", 1.0))]
    rails = [mbd.Prismatic(GROUND.at(), b.at(), axis="y", name=f"rail_{b.name}") for b in bodies]
    ends = [(GROUND, bodies[0]), (bodies[0], bodies[1])]
    springs = [mbd.AxialSpringDamper(a.at(), b.at(), axis="y", stiffness=50.0, damping=2.0) for a, b in ends]
    return mbd.System(bodies, rails, springs), rails


def test_two_masses_in_closed_form():
    system, rails = carriage()
    linear = mbd.vibrations.linearize(
        system,
        [mbd.signals.JointForce(rails[1])],
        [mbd.signals.JointTravel(rails[0]), mbd.signals.JointSpeed(rails[1]), mbd.signals.PointPosition(rails[1].b)],
    )
    M, one = np.diag([2.0, 1.0]), np.array([[2.0, -1.0], [-1.0, 1.0]])
    s = 2j * np.pi * np.array([0.4, 1.1])
    got = linear.response([0.4, 1.1])
    for k, x in enumerate(s):
        y = np.linalg.solve(x**2 * M + x * 2.0 * one + 50.0 * one, [0.0, 1.0])
        np.testing.assert_allclose(got[k, :, 0], [y[0], x * y[1], 0.0, y[1], 0.0], rtol=1e-9, atol=1e-15)
    assert linear.outputs == ["JointTravel 1", "JointSpeed 2", *(f"PointPosition 3 {axis}" for axis in "xyz")]
    assert linear.states[:2] == ["displacement y of 'first'", "displacement y of 'second'"]
    poles = mbd.equilibrium(system).poles[0].numpy()
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(linear.A)), np.sort_complex(poles), rtol=1e-9)
    assert linear.to_scipy().A.shape == (4, 4)


def test_under_control():
    """A hanging pendulum with a servo: m L^2 angle'' = -m g L angle - 3 angle - 0.5 angle' + torque."""
    [hinge] = mbd.examples.pendulum(length=2.0).joints
    bob = hinge.b.body
    gains = torch.nn.Linear(2, 1, bias=False).double()
    with torch.no_grad():
        gains.weight[:] = torch.tensor([[-3.0, -0.5]])
    angle = [mbd.signals.JointAngle(hinge), mbd.signals.JointRate(hinge)]
    servo = mbd.Controller(gains, angle, [mbd.signals.JointTorque(hinge)], name="servo")
    system = mbd.System([bob], [hinge], [servo], gravity=(0.0, -9.81, 0.0))
    linear = mbd.vibrations.linearize(system, [mbd.signals.JointTorque(hinge)], angle)
    T = np.diag([linear.C[0, 0], linear.C[1, 1]])  # states as angles
    A, B = T @ linear.A @ np.linalg.inv(T), T @ linear.B
    m = float(bob.mass)
    np.testing.assert_allclose(A[1] / B[1, 0], [-m * 9.81 * 2.0 - 3.0, -0.5], rtol=1e-9)


@pytest.mark.thorough
def test_of_a_rotor_seen_from_the_ground():
    system = rotor(1.5, {0.5: 0.28}, (0.0, 1.5), (1e6, 0.8e6), 6)
    state = mbd.equilibrium(system, spin=(200.0, 0.0, 0.0), observer="ground", unstable=True)
    disk = system.body("disk0")
    linear = mbd.vibrations.linearize(
        system, [mbd.signals.ForceOn(disk.at(), "y")], [mbd.signals.PointPosition(disk.at())], state
    )
    got, expected = (np.sort(np.abs(x.imag)) for x in (np.linalg.eigvals(linear.A), state.poles[0].numpy()))
    assert expected[:2].tolist() == [0.0, 0.0]  # the free spin, of which `got` has the root of rounding
    np.testing.assert_allclose(got[2:], expected[2:], rtol=1e-6)


def test_bad_arguments_are_named():
    system, rails = carriage()
    force, travel = [mbd.signals.JointForce(rails[0])], [mbd.signals.JointTravel(rails[0])]
    for call, path in (
        (lambda: mbd.vibrations.linearize(3, force, travel), "system"),
        (lambda: mbd.vibrations.linearize(system, [], travel), "inputs"),
        (lambda: mbd.vibrations.linearize(system, travel, travel), "inputs"),
        (
            lambda: mbd.vibrations.linearize(system, [mbd.signals.JointTorque(hinged(1.0)[1])], travel),
            "forces.inputs and outputs",
        ),
        (lambda: mbd.vibrations.linearize(system, force, [mbd.signals.Time()]), "outputs"),
        (lambda: mbd.vibrations.linearize(system, force, travel, state=3), "state"),
        (lambda: mbd.vibrations.linearize(system, force, travel, lane=4), "lane"),
        (lambda: mbd.vibrations.linearize(system, force, travel, mbd.equilibrium(mbd.examples.pendulum())), "state"),
        (lambda: mbd.vibrations.linearize(system, force, []), "outputs"),
        (lambda: mbd.vibrations.linearize(system, force, travel, time=0.3), "time"),
        (lambda: mbd.vibrations.linearize(system, force, travel, coordinates=["x"]), "coordinates"),
        (lambda: mbd.vibrations.linearize(system, force, travel).response(np.nan), "frequencies"),
    ):
        with refused(path):
            call()
    before = mbd.equilibrium(system, [-1.0, 0.0])
    assert mbd.vibrations.linearize(system, force, travel, before, time=-1.0).A.shape == (4, 4)


@pytest.mark.thorough
def test_the_difference_of_two_motions_follows_the_matrices():
    """x' = A(t) x by Runge and Kutta's rule, and y = C(t) x; of a spatial double pendulum."""
    system = rigid_pendulum()
    T, hinge, size = system.topology, system.joints[0], 1e-5
    ports = [mbd.signals.JointTorque(hinge)], [mbd.signals.JointAngle(hinge), mbd.signals.JointRate(hinge)]
    first = system.body("first").angular_velocity
    at_rates = [first + sign * size * torch.tensor([1.0, 0.5, -0.3]) for sign in (-1.0, 1.0)]
    options = {"duration": 0.1, "steps": 60, "gradients": "none"}
    motion = mbd.simulate(system, **options)
    sides = [mbd.simulate(system, start={"first.angular_velocity": w.double()}, **options) for w in at_rates]
    q, v = ((getattr(sides[1], x) - getattr(sides[0], x))[0] / (2.0 * size) for x in ("q", "v"))
    p, dp = (x[:, 3 * T.bodies : 7 * T.bodies].unflatten(1, (4, T.bodies)) for x in (motion.q[0], q))
    turn = 2.0 * (p[:, :1] * dp[:, 1:] - dp[:, :1] * p[:, 1:] - torch.linalg.cross(p[:, 1:], dp[:, 1:], dim=1))
    omega, change = (x[:, 3 * T.bodies :].unflatten(1, (3, T.bodies)) for x in (motion.v[0], v))
    rate = change - torch.linalg.cross(omega, turn, dim=1)
    along = [mbd.vibrations.linearize(system, *ports, motion, time=float(t)) for t in motion.t]
    names = [f"rotation {axis} of {body!r}" for axis in "xyz" for body in T.names]
    rows = [names.index(name) for name in along[0].states[:4]]
    assert all(x.states == along[0].states for x in along)
    expected = torch.cat([x.flatten(1)[:, rows] for x in (turn, rate)], 1).numpy()
    x, h = expected[0], 2.0 * float(motion.t[1])
    for before, between, after in zip(along[:-2:2], along[1:-1:2], along[2::2], strict=True):
        k1 = before.A @ x
        k2 = between.A @ (x + 0.5 * h * k1)
        k3 = between.A @ (x + 0.5 * h * k2)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + after.A @ (x + h * k3))
    np.testing.assert_allclose(x, expected[-1], rtol=0.0, atol=1e-4 * np.abs(expected[-1]).max())
    assert np.abs(x - expected[0]).max() > 0.1 * np.abs(x).max()
    first = T.names.index("first")
    axis = rotation_matrix(p[-1]).numpy()[:, :, first].T @ hinge.a.axes.numpy()[:, 0]
    wanted_outputs = [axis @ y[-1, :, first].numpy() for y in (turn, rate)]
    np.testing.assert_allclose(along[-1].C @ expected[-1], wanted_outputs, rtol=1e-4)


def hinged(length: float) -> tuple[mbd.System, mbd.Joint]:
    bob = mbd.RigidBody("bob", 1.0, (0.1, 0.1, 0.1), position=(0, -length, 0))
    hinge = mbd.Revolute(mbd.Ground().at(), bob.at(0, length, 0), axis="z", name="hinge")
    return mbd.System([bob], [hinge], gravity=(0, -9.81, 0)), hinge


def test_a_state_of_another_system_is_refused():
    """With as many coordinates, it would give matrices of a state that is none."""
    state, (system, hinge) = mbd.equilibrium(hinged(1.0)[0]), hinged(2.0)
    ports = [mbd.signals.JointTorque(hinge)], [mbd.signals.JointAngle(hinge)]
    assert mbd.vibrations.linearize(system, *ports, mbd.equilibrium(system)).A[1, 0] == pytest.approx(-2.0 * 9.81 / 4.1)
    with refused("state"):
        mbd.vibrations.linearize(system, *ports, state)


def test_a_motion_of_another_system_or_in_phases_is_refused():
    system, hinge = hinged(1.0)
    ports = [mbd.signals.JointTorque(hinge)], [mbd.signals.JointAngle(hinge)]
    other, other_hinge = hinged(2.0)
    others = [mbd.signals.JointTorque(other_hinge)], [mbd.signals.JointAngle(other_hinge)]
    motion = mbd.simulate(system, 0.1, steps=10, start={"bob.angular_velocity": torch.tensor([0.0, 0.0, 3.0]).double()})
    assert mbd.vibrations.linearize(system, *ports, motion, time=0.05).states[0] == "rotation z of 'bob'"
    for call, path in (
        (
            lambda: mbd.vibrations.linearize(system, *ports, motion, time=0.051),
            "time",
        ),
        (lambda: mbd.vibrations.linearize(system, *ports, motion, time=-1.0), "time"),
        (
            lambda: mbd.vibrations.linearize(other, *others, motion),
            "state",
        ),
    ):
        with refused(path):
            call()
    short = mbd.simulate(system, 0.1, steps=10, phases=[mbd.Phase(until=0.05), mbd.Phase(lock=["hinge"])])
    with refused("state"):
        mbd.vibrations.linearize(system, *ports, short)
    motion.status[0] = "failed: steps are too long"
    with pytest.raises(mbd.SimulationFailure, match="lane 0: failed: steps are too long"):
        mbd.vibrations.linearize(system, *ports, motion)


def test_the_response_at_a_pole_is_refused():
    body = mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0))
    rail = mbd.Prismatic(mbd.Ground().at(), body.at(), axis="y")
    linear = mbd.vibrations.linearize(
        mbd.System([body], [rail]), [mbd.signals.JointForce(rail)], [mbd.signals.JointTravel(rail)]
    )
    with refused("frequencies"):
        linear.response([1.0, 0.0])
