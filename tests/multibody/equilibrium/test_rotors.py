"""Overhung rotors: whirl, unbalance and stability below and above the critical speed, by the closed forms of massless shafts.

The disk of mass m and inertias J_p about the shaft, J_d across it at the end of a shaft of length L:

    [L^3 / 3, L^2 / 2; L^2 / 2, L]^-1 E I = K,   m r'' + ..., J_d f'' - i J_p speed f' + ... = 0     fixed axes, complex
    (K - speed^2 diag(m, J_d - J_p)) (r, f) = (m speed^2 e, 0)                                        turning axes, unbalance e
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import ANY, refused

LENGTH, E, MASS, RADIUS = 0.5, 210e9, 2.0, 0.1
POLAR, ACROSS = 0.5 * MASS * RADIUS**2, 0.25 * MASS * RADIUS**2
INERTIA = math.pi * 0.01**4 / 64.0  # of the section
FLEXIBILITY = np.array([[LENGTH**3 / 3.0, LENGTH**2 / 2.0], [LENGTH**2 / 2.0, LENGTH]])
CRITICAL = 36.0  # rad/s


def rotor(speed: float, end: Any = 0.0, damping: float = 0.0, flat: float = 1.0) -> mbd.System:
    """A disk on a shaft without mass, turned by a motor.

    end    y of the shaft on the disk [m]
    flat   second moment of area about z by that about y
    """
    section = mbd.GivenSection.isotropic(
        E, 0.3, 25.0, math.pi * 0.005**2, Iyy=INERTIA, Izz=flat * INERTIA, J=2.0 * INERTIA
    )
    shaft = mbd.FlexibleBeam("shaft", mbd.BeamLine.straight(LENGTH, elements=24), section, damping=damping)
    disk = mbd.RigidBody("disk", MASS, (POLAR, ACROSS, ACROSS), position=(LENGTH, 0.0, 0.0))
    ground = mbd.Ground()
    joints = [mbd.Fixed(shaft.at("end"), disk.at(0.0, end, 0.0))]
    if not speed:
        return mbd.System([shaft, disk], [*joints, mbd.Fixed(ground.at(), shaft.at("start"))])
    joints.append(mbd.Revolute(ground.at(), shaft.at("start"), axis="x"))
    joints.append(mbd.Drive(ground.at(), shaft.at("start"), axis="x", speed=speed))
    return mbd.System([shaft, disk], joints)


def turning(speed: float, **others: float) -> mbd.integrate.Equilibrium:
    return mbd.equilibrium(rotor(speed, **others), spin=(speed, 0.0, 0.0), unstable=True)


def whirl(speed: float) -> list[float]:
    """Four frequencies [Hz] that a turning observer sees."""
    M = np.diag([MASS, ACROSS])
    left = np.linalg.solve(
        M, np.hstack([-E * INERTIA * np.linalg.inv(FLEXIBILITY), np.diag([0.0, 1j * POLAR * speed])])
    )
    poles = np.linalg.eigvals(np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), left]))
    return sorted(abs(poles.imag - speed) / (2.0 * math.pi))


@pytest.mark.thorough
def test_a_heavy_disk_on_a_light_shaft_is_not_free():
    """The squares of its frequency and of the highest one of the elements differ by more than 1e10."""
    rest = mbd.equilibrium(rotor(0.0))
    assert rest.vibrations[0].frequencies[:2].tolist() == pytest.approx(whirl(0.0)[:2], rel=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("speed", [20.0, 50.0, 150.0, 300.0])
def test_whirl_and_unbalance(speed):
    e = 1e-4
    rest = turning(speed, end=-e)
    result = rest.vibrations[0].frequencies
    assert rest.stable
    for expected in whirl(speed):
        assert float((result - expected).abs().min()) < 2e-3 * expected + 2e-3
    K = E * INERTIA * np.linalg.inv(FLEXIBILITY) - speed**2 * np.diag([MASS, ACROSS - POLAR])
    place, _ = np.linalg.solve(K, [MASS * speed**2 * e, 0.0])
    assert rest.body("shaft").at("end").position[0, 0, 1].item() == pytest.approx(place, rel=5e-3)


@pytest.mark.thorough
@pytest.mark.parametrize(("speed", "stable"), [(0.9 * CRITICAL, True), (1.2 * CRITICAL, False)])
def test_damping_of_the_shaft_drives_whirl_above_the_critical_speed(speed, stable):
    rest = turning(speed, damping=1e-3)
    assert rest.stable == stable
    assert rest.vibrations[0].frequencies[1:3].tolist() == pytest.approx(
        turning(speed).vibrations[0].frequencies[1:3].tolist(), rel=1e-6
    )


@pytest.mark.thorough
@pytest.mark.parametrize(("speed", "stable"), [(32.0, True), (45.0, False), (60.0, True)])
def test_a_flat_shaft_is_unstable_between_its_critical_speeds(speed, stable):
    """36 and 50 rad/s."""
    assert turning(speed, flat=2.0).stable == stable


@pytest.mark.thorough
def test_without_the_option_a_shaft_ends_at_its_critical_speed():
    with refused("system", ANY, "buckles at 0.50", "unstable=True"):
        mbd.equilibrium(rotor(50.0), spin=(50.0, 0.0, 0.0))


@pytest.mark.thorough
def test_the_state_has_derivatives():
    system = rotor(50.0, end=mbd.variable(-1e-4))
    [name] = [name for name, x in system.named_parameters() if x.requires_grad]
    ends = torch.tensor([-1e-4, -1.01e-4, -0.99e-4], dtype=torch.float64, requires_grad=True)
    rest = mbd.equilibrium(system, spin=(50.0, 0.0, 0.0), unstable=True, designs={name: ends})
    y = rest.body("shaft").at("end").position[:, 0, 1]
    [slope] = torch.autograd.grad(y[0], ends)
    assert slope.tolist() == [pytest.approx(float((y[1] - y[2]) / (ends[1] - ends[2])), rel=1e-5), 0.0, 0.0]
