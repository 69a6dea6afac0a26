"""Matrices for control: closed forms, differences of the equations of motion, and the poles of the same state."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.multibody.system.test_ground_observer import rotor

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
    linear = mbd.linearize(
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
    linear = mbd.linearize(system, [mbd.signals.JointTorque(hinge)], angle)
    T = np.diag([linear.C[0, 0], linear.C[1, 1]])  # states as angles
    A, B = T @ linear.A @ np.linalg.inv(T), T @ linear.B
    m = float(bob.mass)
    np.testing.assert_allclose(A[1] / B[1, 0], [-m * 9.81 * 2.0 - 3.0, -0.5], rtol=1e-9)


@pytest.mark.thorough
def test_of_a_rotor_seen_from_the_ground():
    system = rotor(1.5, {0.5: 0.28}, (0.0, 1.5), (1e6, 0.8e6), 6)
    state = mbd.equilibrium(system, spin=(200.0, 0.0, 0.0), observer="ground", unstable=True)
    disk = system.body("disk0")
    linear = mbd.linearize(system, [mbd.signals.ForceOn(disk.at(), "y")], [mbd.signals.PointPosition(disk.at())], state)
    got, wanted = (np.sort(np.abs(x.imag)) for x in (np.linalg.eigvals(linear.A), state.poles[0].numpy()))
    np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-4)


def test_bad_arguments_are_named():
    system, rails = carriage()
    force, travel = [mbd.signals.JointForce(rails[0])], [mbd.signals.JointTravel(rails[0])]
    for call, words in (
        (lambda: mbd.linearize(3, force, travel), "system is 3"),
        (lambda: mbd.linearize(system, [], travel), "inputs is empty"),
        (lambda: mbd.linearize(system, travel, travel), "inputs"),
        (lambda: mbd.linearize(system, force, [mbd.signals.Time()]), "outputs has the time"),
        (lambda: mbd.linearize(system, force, travel, state=3), "state is 3"),
        (lambda: mbd.linearize(system, force, travel, lane=4), "lane is 4"),
        (lambda: mbd.linearize(system, force, travel, mbd.equilibrium(mbd.examples.pendulum())), "coordinates"),
        (lambda: mbd.linearize(system, force, []), "outputs is empty"),
        (lambda: mbd.linearize(system, force, travel).response(np.nan), "frequencies is nan"),
    ):
        with pytest.raises(mbd.InputError, match=words):
            call()


def hinged(length: float) -> tuple[mbd.System, mbd.Joint]:
    bob = mbd.RigidBody("bob", 1.0, (0.1, 0.1, 0.1), position=(0, -length, 0))
    hinge = mbd.Revolute(mbd.Ground().at(), bob.at(0, length, 0), axis="z")
    return mbd.System([bob], [hinge], gravity=(0, -9.81, 0)), hinge


def test_a_state_of_another_system_is_refused():
    """With as many coordinates, it would give matrices of a state that is none."""
    state, (system, hinge) = mbd.equilibrium(hinged(1.0)[0]), hinged(2.0)
    ports = [mbd.signals.JointTorque(hinge)], [mbd.signals.JointAngle(hinge)]
    assert mbd.linearize(system, *ports, mbd.equilibrium(system)).A[1, 0] == pytest.approx(-2.0 * 9.81 / 4.1)
    with pytest.raises(mbd.InputError, match="state is no equilibrium of the system"):
        mbd.linearize(system, *ports, state)


def test_the_response_at_a_pole_is_refused():
    body = mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0))
    rail = mbd.Prismatic(mbd.Ground().at(), body.at(), axis="y")
    linear = mbd.linearize(mbd.System([body], [rail]), [mbd.signals.JointForce(rail)], [mbd.signals.JointTravel(rail)])
    with pytest.raises(mbd.InputError, match="frequencies has 0 Hz, a pole without damping"):
        linear.response([1.0, 0.0])
