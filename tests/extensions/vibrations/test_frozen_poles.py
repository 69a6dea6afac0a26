"""Poles at a time of a motion and their derivatives: closed form, forward = reverse = differences, what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.refused import refused
from tests.sensitivity.number_cases import differences

V, GROUND = mbd.variable, mbd.Ground()
PHASES = [mbd.Phase(until=0.05), mbd.Phase(lock=["hinge"])]


def swinging(J: float = 0.1, gravity: float = 9.81) -> mbd.System:
    bob = mbd.RigidBody("bob", V(1.5), (J, J, J), position=(0, -2.0, 0), angular_velocity=(0, 0, 3.0))
    hinge = mbd.Revolute(GROUND.at(), bob.at(0, 2.0, 0), axis="z", name="hinge")
    return mbd.System([bob], [hinge], gravity=(0, -gravity, 0))


def test_of_a_pendulum_by_its_mass():
    """s^2 = -m g L cos(angle) / (m L^2 + J), through the angle as well."""
    mass = torch.tensor([1.5, 2.0], dtype=torch.float64, requires_grad=True)
    motion = mbd.simulate(swinging(), 0.6, steps=200, designs={"bob.mass": mass})
    s, angle = mbd.vibrations.frozen_poles(motion, 0.3), mbd.Angle("bob", "z")(motion)[:, 100]
    expected = torch.sqrt(mass * 9.81 * 2.0 * torch.cos(angle) / (4.0 * mass + 0.1))
    assert_close(s[:, 1].imag, expected, rtol=1e-6, atol=0.0)
    slopes = [torch.autograd.grad(x.sum(), mass, retain_graph=True)[0] for x in (s[:, 1].imag, expected)]
    assert_close(slopes[0], slopes[1], rtol=1e-4, atol=0.0)
    assert float(slopes[1].abs().min()) > 1e-3


@pytest.mark.thorough
def test_of_a_flexible_double_pendulum():
    """By ply angles and thickness: reverse, torch.func in both modes, and differences.

    Tangents and adjoint of the motion differ by what iterations of the steps leave, 2e-9 of a rate at 100 steps.
    """
    system, names = pendulum(damping=1e-4), ["rod.laminate.angles", "rod.laminate.thickness"]

    def value(designs: dict[str, Tensor]) -> Tensor:
        s = mbd.vibrations.frozen_poles(mbd.simulate(system, 0.05, steps=100, designs=designs))
        return (s.real + 0.3 * s.imag.abs()).square().sum(1)

    start = {name: system.get_parameter(name).detach().clone() for name in names}
    single = lambda b: value({name: y[None] for name, y in b.items()})[0]  # noqa: E731
    x = {name: y[None].clone().requires_grad_() for name, y in start.items()}
    value(x).sum().backward()
    forward, reverse = torch.func.jacfwd(single)(start), torch.func.jacrev(single)(start)
    expected = differences(value, system, names)
    for name, y in x.items():
        assert y.grad is not None
        size = float(y.grad.abs().max())
        for other, bound in ((forward, 1e-9), (reverse, 1e-9), (expected, 1e-6)):
            assert_close(other[name], y.grad[0], rtol=0.0, atol=bound * size, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.thorough
def test_by_the_duration_of_a_driven_motion():
    """The last time is one of the drive's law as well; forward = reverse = differences."""
    carriage, bob = (
        mbd.RigidBody("carriage", 3.0, (1.0,) * 3),
        mbd.RigidBody("bob", 1.5, (0.01,) * 3, position=(0, -2, 0)),
    )
    joints = [
        mbd.Prismatic(GROUND.at(), carriage.at(), axis="x"),
        mbd.Drive(GROUND, carriage, axis="x", position=mbd.Sine(0.5, 0.5)),
        mbd.Revolute(carriage.at(), bob.at(0, 2.0, 0), axis="z"),
    ]
    system = mbd.System([carriage, bob], joints, gravity=(0, -9.81, 0))

    def swing(duration: Tensor) -> Tensor:
        return mbd.vibrations.frozen_poles(mbd.simulate(system, duration, steps=60))[0, 1].imag

    T, h = torch.tensor(0.6, dtype=torch.float64), 1e-4
    expected = ((swing(T + h) - swing(T - h)) / (2.0 * h)).item()
    for mode in (torch.func.jacrev, torch.func.jacfwd):
        assert mode(swing)(T).item() == pytest.approx(expected, rel=1e-6)


def test_what_has_no_derivative_is_named():
    """The poles of a free turn, which are zero; values are there."""
    mass = torch.tensor([1.5], dtype=torch.float64, requires_grad=True)
    s = mbd.vibrations.frozen_poles(mbd.simulate(swinging(gravity=0.0), 0.1, steps=20, designs={"bob.mass": mass}))
    assert s.abs().max().item() < 1e-6
    with refused("number", 1, kind=mbd.DesignFailure):
        s.imag.sum().backward()


@pytest.mark.thorough
def test_bad_arguments_are_named():
    motion = mbd.simulate(swinging(), 0.1, steps=10)
    for call, path in (
        (lambda: mbd.vibrations.frozen_poles(3), "motion"),
        (lambda: mbd.vibrations.frozen_poles(mbd.equilibrium(swinging())), "motion"),
        (
            lambda: mbd.vibrations.frozen_poles(mbd.simulate(swinging(), 0.1, steps=10, phases=PHASES)),
            "motion",
        ),
        (lambda: mbd.vibrations.frozen_poles(motion, 0.1001), "time"),
        (lambda: mbd.vibrations.frozen_poles(motion, "0.1"), "time"),
        (lambda: mbd.vibrations.frozen_poles(motion, coordinates=["angle"]), "coordinates"),
        (lambda: mbd.vibrations.frozen_poles(motion, coordinates="rotation z of 'bob'"), "coordinates"),
        (lambda: mbd.vibrations.frozen_poles(motion, coordinates=3), "coordinates"),
        (lambda: mbd.vibrations.frozen_poles(motion, coordinates=[]), "coordinates"),
    ):
        with refused(path):
            call()

    def poles(mass: Tensor) -> Tensor:
        return mbd.vibrations.frozen_poles(
            mbd.simulate(swinging(), 0.1, steps=10, designs={"bob.mass": mass[None]})
        ).imag

    with refused("motion"):
        torch.vmap(poles)(torch.tensor([1.0, 2.0], dtype=torch.float64))
    single = torch.tensor(0.07, dtype=torch.float32)  # is 2e-9 off the time of the motion
    assert torch.equal(mbd.vibrations.frozen_poles(motion, single), mbd.vibrations.frozen_poles(motion, 0.07))
    assert mbd.vibrations.frozen_poles(motion).imag[0, 1].item() == pytest.approx(math.sqrt(9.81 * 3.0 / 6.1), rel=0.2)
