"""Stiffened bodies: energy and momentum of a free motion, and both sides of a joint, wherever the body frame sits."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import SOFT, box, laminate, plate
from tests.validation.test_flexible_benchmarks import BLADE, GROUND, SpinUp, exact_blade, from_hub
from torchmbd.multibody.equations import equations

pytestmark = pytest.mark.usefixtures("compiled")

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
ROD = "rod.laminate.angles"
ANGLES = torch.tensor([[0.3, -0.8], [0.5, 1.0]], dtype=torch.float64)


def momenta(motion: mbd.Trajectory) -> Tensor:
    """Linear momentum and moment of momentum about the origin [times, 6] of all bodies."""
    T, data = motion.dynamics.topology, {name: x.detach() for name, x in motion.dynamics.data.items()}
    q, v = (getattr(motion, name)[0].T[:, None] for name in ("q", "v"))
    at = equations.placement(T, data, q, T.prescribed(torch.zeros(())))
    force, torque, _ = equations.inertia_forces(T, data | {"Kr": 0.0 * data["Kr"]}, at, torch.zeros_like(v), v)
    r = equations.split_q(T, q)[0]
    about = torch.linalg.cross(r, force, dim=0) + torch.einsum("ijb...,jb...->ib...", at.A[:, :, : T.bodies], torque)
    return torch.cat([force.sum(1)[:, 0], about.sum(1)[:, 0]]).T


@pytest.mark.thorough
def test_a_free_motion_keeps_energy_and_momenta():
    """A plate on a box: terms of second order come from one kinetic energy, none is missing in force, torque or modes."""
    rod = plate("rod", made_of=laminate((20.0, -50.0), 3e-3, SOFT), reference="left", stiffening=True)
    hub = box("hub", position=(-0.15, 0.0, 0.0), velocity=(0.3, -0.2, 0.5), angular_velocity=(2.0, 1.0, 6.0))
    rod.bent(modal=[2e-3, -1e-3, 1e-3], rate=[0.1, 0.05, -0.1])
    system = mbd.System([hub, rod], [mbd.Fixed(hub.at(), rod.at("left"))])
    with torch.no_grad():
        motion = mbd.simulate(system, 0.05, "dopri8", steps=10, rtol=1e-10, atol=1e-12).require_ok()
    energy = (motion.energies.kinetic + motion.energies.strain)[0]
    exchanged = float(motion.energies.strain.max() - motion.energies.strain.min())
    assert exchanged > 1e-3 * float(energy[0])
    assert float((energy - energy[0]).abs().max()) < 1e-5 * exchanged
    result = momenta(motion)
    for own in result.split(3, 1):
        assert float((own - own[0]).abs().max()) < 1e-6 * float(own.norm(dim=1).max())


def hung(stiffening: bool = True) -> mbd.System:
    """A plate turns about a hinge and pulls at a mass beyond it."""
    rod = plate("rod", made_of=laminate((20.0, -50.0), 3e-3, SOFT), reference="left", stiffening=stiffening)
    rod.moving(angular_velocity=(0.0, 0.0, 3.0))
    bob = mbd.RigidBody("bob", 0.05, (1e-5, 1e-5, 1e-5), position=(0.15, 0.0, 0.0))
    joints = [
        mbd.Revolute(GROUND.at(-0.15, 0.0, 0.0), rod.at("left"), axis="z"),
        mbd.Spherical(rod.at("right"), bob.at()),
    ]
    return mbd.System([rod, bob], joints, gravity=(0.0, 0.0, -9.81))


def energies(system: mbd.System, angles: Tensor, **options: Any) -> Tensor:
    motion = mbd.simulate(system, 0.05, steps=50, designs={ROD: angles}, **options).require_ok()
    return mbd.Integral(mbd.StrainEnergy("rod"))(motion)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:body 'rod' turns")
def test_gradients_by_ply_angles():
    """Forward and reverse against differences."""
    system, f = hung(), energies
    angles = ANGLES.clone().requires_grad_()
    reverse = torch.autograd.grad(f(system, angles, gradients="reverse").sum(), angles)[0]
    forward = torch.func.jacfwd(lambda x: f(system, x).sum())(ANGLES)
    h, expected = 1e-4, torch.zeros_like(ANGLES)
    for i in range(2):
        e = torch.zeros_like(ANGLES)
        e[:, i] = h
        one, two = ((f(system, ANGLES + k * e) - f(system, ANGLES - k * e)) / (2 * k * h) for k in (1, 2))
        expected[:, i] = ((4.0 * one - two) / 3.0).reshape(-1)
    scale = float(expected.abs().max())
    torch.testing.assert_close(reverse, forward, rtol=0, atol=1e-9 * scale)
    torch.testing.assert_close(reverse, expected, rtol=0, atol=1e-6 * scale)
    assert float((f(hung(False), ANGLES) - f(system, ANGLES)).abs().max()) > 0.01 * float(f(system, ANGLES).abs().max())


@pytest.mark.thorough
@needs_compiler
def test_native_steps_are_eager_steps(native: None):
    system = hung()
    eager, fast = (
        mbd.simulate(system, 0.05, steps=50, designs={ROD: ANGLES}, gradients="forward", backend=backend)
        for backend in ("eager", "native")
    )
    assert (eager.stats["backend"], fast.stats["backend"]) == ("eager", "native")
    torch.testing.assert_close(fast.q, eager.q, rtol=0, atol=1e-11)
    assert float((fast.dq_db - eager.dq_db).abs().max()) < 1e-9 * float(eager.dq_db.abs().max())


@pytest.mark.thorough
@needs_compiler
@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("reference", ["start", "center"])
def test_spin_up_at_six_radians_a_second(native: None, reference: str):
    """Kane, Ryan, Banerjee: 5.14e-4 m and 0.57 m. From the middle the hinge's force stiffens, too, from the start inertia."""
    ends = tuple(x for x in ("start", "end") if x != reference)
    place = {"start": 0.0, "center": 5.0}[reference]
    body = BLADE.body("blade", reference=reference, interface=ends, position=(place, 0.0, 0.0), stiffening=True)
    law = SpinUp(6.0)
    hub = body.at("start")
    joints = [mbd.Revolute(GROUND.at(), hub, axis="z"), mbd.Drive(GROUND.at(), hub, axis="z", angle=law)]
    motion = mbd.simulate(mbd.System([body], joints), 20.0, steps=800, backend="native").require_ok()
    result = from_hub(law, motion.t, motion.body("blade").at("end").position[0, :, :2].numpy())
    exact = exact_blade(6.0, 20.0, 800)
    assert np.abs(result[:, 0]).max() == pytest.approx(np.abs(exact[:, 0]).max(), rel=1e-2)
    assert result[-160:, 1].mean() == pytest.approx(5.14e-4, rel=1e-2)
    assert np.abs(result[:, 0] - exact[:, 0]).max() < 2e-2 * np.abs(exact[:, 0]).max()
    assert float(motion.energies.balance[0].abs().max()) < 1e-2 * float(motion.energies.kinetic[0].max())
