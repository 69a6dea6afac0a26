"""Frequency responses beside the matrices of `linearize`; derivatives by differences, forward and reverse."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.extensions.vibrations.test_linear_system import carriage as two_masses
from tests.refused import refused
from torchmbd.extensions.vibrations.frequency_response import frequency_response
from torchmbd.extensions.vibrations.linear_system import system_with_ports
from torchmbd.extensions.vibrations.port_functions import Ports

HERTZ = torch.tensor([1.5, 7.0, 40.0], dtype=torch.float64)  # between vibrations at 1.1, 3.0, 10.9, 17.8 and 31.8 Hz


def crane() -> tuple[mbd.System, list, list]:
    """A laminated arm that sags on a spring hinge, out of its plane too, with a load at its end; forces and signals aside."""
    ground, numbers = (
        mbd.Ground(),
        {"E1": mbd.variable(60e9), "E2": 9e9, "G12": mbd.variable(5e9), "G13": 5e9, "G23": 3e9},
    )
    ply = mbd.Ply(**numbers, nu12=0.3, density=1600.0)
    section = mbd.sections.strip(0.04, ply, mbd.deg([25.0, -10.0, 70.0]), 0.7e-3, cells=(4, 1))
    arm = mbd.FlexibleBeam("arm", mbd.BeamLine.straight(0.6, 4), section, orientation=(0.0, 0.8, 0.6), damping=2e-3)
    load = mbd.RigidBody("load", mbd.variable(0.15), (1e-4, 2e-4, 3e-4), position=(0.6, 0, 0), center=(0.01, 0.02, 0.0))
    hinge = mbd.Revolute(ground.at(), arm.at("start"), axis="y", name="hinge")
    joints = [hinge, mbd.Fixed(arm.at("end"), load.at(), name="grip")]
    law = {"stiffness": mbd.variable(9.0), "damping": mbd.variable(0.05)}
    spring = mbd.RotationalSpringDamper(ground.at(), arm.at("start"), "y", name="spring", **law)
    inputs = [mbd.signals.JointTorque(hinge), mbd.signals.ForceOn(load.at(0.0, 0.03, 0.0), "z", axes="frame")]
    outputs = [mbd.signals.JointAngle(hinge), mbd.signals.PointVelocity(load.at(0.05, 0.0, 0.0))]
    return mbd.System([arm, load], joints, [spring], gravity=(0.0, 1.0, -9.81)), inputs, outputs


def carriage() -> tuple[mbd.System, list, list]:
    """Two masses on a rail between springs and dampers."""
    system, rails = two_masses()
    outputs = [mbd.signals.JointTravel(rails[0]), mbd.signals.JointSpeed(rails[1])]
    return system, [mbd.signals.JointForce(rail) for rail in rails], outputs


NAMES = [
    "spring.stiffness",
    "spring.damping",
    "load.mass",
    "arm.section.ply.E1",
    "arm.section.ply.G12",
    "arm.section.angles",
]


def ported() -> tuple[mbd.System, Ports]:
    system, inputs, outputs = crane()
    ports = Ports(len(inputs))
    return system_with_ports(system, ports, inputs, outputs), ports


def response(
    designs: dict[str, torch.Tensor] | None = None, model: tuple[mbd.System, Ports] | None = None
) -> torch.Tensor:
    system, ports = model or ported()
    return frequency_response(mbd.equilibrium(system, designs=designs), ports, HERTZ)


@pytest.mark.parametrize(
    ("model", "share"),
    [
        (carriage, 1e-12),
        pytest.param(crane, 1e-7, marks=pytest.mark.thorough),
    ],  # modes of bodies are those of two searches
)
def test_numbers_are_those_of_the_matrices(model, share):
    """About the same state."""
    system, inputs, outputs = model()
    ports = Ports(len(inputs))
    rest = mbd.equilibrium(system_with_ports(system, ports, inputs, outputs))
    G = frequency_response(rest, ports, HERTZ).detach()
    expected = mbd.vibrations.linearize(system, inputs, outputs, rest).response(HERTZ.numpy())
    np.testing.assert_allclose(G[0].numpy(), expected, rtol=0.0, atol=share * float(G.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_those_of_differences(name):
    """In general position: the arm sags, so that the state moves with the design."""
    model = ported()
    x = dict(model[0].named_parameters())[name].detach()[None]
    scale = response().detach().abs().amax((0, 1), keepdim=True)
    w = torch.randn(2, 3, 4, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def number(y: torch.Tensor) -> torch.Tensor:
        G = response({name: y}, model)
        return (w[0] * G.real / scale + w[1] * G.imag / scale).flatten(1).sum(1)

    leaf = x.clone().requires_grad_()
    [slope] = torch.autograd.grad(number(leaf).sum(), leaf)
    direction = torch.ones_like(x) if name.endswith("angles") else x
    _, forward = torch.func.jvp(number, (x,), (direction,))
    h = 1e-2
    with torch.no_grad():
        at = torch.cat([number(x + k * h * direction) for k in (-3, -2, -1, 1, 2, 3)])
    expected = (45.0 * (at[3] - at[2]) - 9.0 * (at[4] - at[1]) + (at[5] - at[0])) / (60.0 * h)
    rounding = 1e-7 * float(at.abs().max())  # of states at rest
    assert float((slope * direction).sum()) == pytest.approx(float(expected), rel=1e-6, abs=rounding)
    assert float(forward) == pytest.approx(float((slope * direction).sum()), rel=1e-8)


@pytest.mark.thorough
def test_lanes_are_designs_of_their_own():
    masses = torch.tensor([0.1, 0.2], dtype=torch.float64)
    both = response({"load.mass": masses}).detach()
    for k in range(2):
        torch.testing.assert_close(
            both[k : k + 1], response({"load.mass": masses[k : k + 1]}).detach(), rtol=1e-7, atol=1e-10
        )


def test_a_pole_without_damping_is_refused():
    rails = [mbd.Prismatic(mbd.Ground().at(), mbd.RigidBody("car", 1.0, (1, 1, 1)).at(), axis="x", name="rail")]
    car = rails[0].b.body
    spring = mbd.AxialSpringDamper(mbd.Ground().at(), car.at(), axis="x", stiffness=(2.0 * np.pi * 7.0) ** 2)
    ports = Ports(1)
    system = system_with_ports(
        mbd.System([car], rails, [spring]),
        ports,
        [mbd.signals.JointForce(rails[0])],
        [mbd.signals.JointTravel(rails[0])],
    )
    with refused("frequencies"):
        frequency_response(mbd.equilibrium(system), ports, HERTZ)
