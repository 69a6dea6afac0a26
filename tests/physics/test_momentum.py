"""Linear and angular momentum of what floats freely: inertia coupling between rotation and bending has no net force."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import SOFT, box, laminate, plate, tensor, turned
from tests.physics.nodal_sums import sums

pytestmark = pytest.mark.usefixtures("compiled")


def floating_plate() -> mbd.System:
    """Its frame sits at a corner: the first moment does not vanish, and damping must not brake the whole."""
    made_of = laminate(ply=SOFT)
    moving = {"velocity": (1.0, 2.0, -1.0), "angular_velocity": (10.0, 15.0, -6.0), "axes": turned(0.3, -0.2, 0.8)}
    return mbd.System([plate("plate", made_of=made_of, reference="corner_left_top", damping=1e-4, **moving)])


def floating_mechanism() -> mbd.System:
    arm = box("arm", velocity=(1.0, 0.0, 2.0), angular_velocity=(5.0, -3.0, 8.0))
    swing = turned(-0.5, 0.2, 0.9)
    origin = tensor(0.2, 0.1, -0.05) - swing @ tensor(-0.15, 0.0, 0.0)
    made_of = laminate(ply=SOFT)
    rod = plate(
        "rod",
        made_of=made_of,
        position=origin,
        axes=swing,
        velocity=(1.0, 2.0, -1.0),
        angular_velocity=(4.0, -5.0, 10.0),
    )
    return mbd.System([arm, rod], [mbd.Universal(arm.at(0.2, 0.1, -0.05), rod.at("left"), axes="zx")])


@pytest.mark.thorough
@pytest.mark.parametrize("build", [floating_plate, floating_mechanism])
def test_momentum_is_kept(build):
    motion = mbd.simulate(build(), 0.05, "dopri5", steps=5, rtol=1e-9, atol=1e-11).require_ok()
    result = sums(motion)
    assert float(result.strain.max()) > 1e-4 * float(result.kinetic.max())
    for x in (result.momentum, result.moment):
        assert float((x - x[0]).norm(dim=1).max()) < 1e-9 * float(x.norm(dim=1).max())


@pytest.mark.thorough
def test_the_center_of_mass_of_a_free_body_moves_on_a_parabola():
    """Gravity acts on every node, bent or not."""
    gravity = tensor(1.0, -2.0, -9.0)
    body = plate("plate", made_of=laminate(ply=SOFT), velocity=(1.0, 2.0, 3.0), angular_velocity=(5.0, 8.0, -3.0))
    motion = mbd.simulate(mbd.System([body], gravity=gravity), 0.1, "rk4", steps=50)
    mass = (body.laminate.mass_per_area * body.matrices.area).detach()
    center = torch.einsum("n,tni->ti", mass / mass.sum(), motion.body("plate").nodes[0])
    t = motion.t[:, None]
    fall = center[0] + t * (sums(motion).momentum[0] / mass.sum()) + 0.5 * t * t * gravity
    assert float((center - fall).abs().max()) < 1e-9


def floating_chain() -> mbd.System:
    """Three rigid bodies on two joints, tumbling."""
    tip = tensor(0.2, 0.1, -0.05)
    spins = ((5.0, -3.0, 8.0), (1.0, 2.0, -6.0), (-4.0, 0.5, 2.0))
    bodies = [
        box(f"box_{k}", position=k * tip, velocity=(1.0, 0.0, 2.0), angular_velocity=spin)
        for k, spin in enumerate(spins)
    ]
    joints = [
        mbd.Universal(bodies[0].at(*tip.tolist()), bodies[1].at(), axes="zx"),
        mbd.Spherical(bodies[1].at(*tip.tolist()), bodies[2].at()),
    ]
    return mbd.System(bodies, joints, stabilization=0.01)


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [0.2, pytest.param(10.0, marks=pytest.mark.slow)])
def test_momentum_of_a_floating_chain(duration):
    """To 1e-10 over 10 s; the energy with it."""
    motion = mbd.simulate(floating_chain(), duration, "dopri8", steps=5, rtol=1e-13, atol=1e-14).require_ok()
    result = sums(motion)
    for x in (result.momentum, result.moment, result.energy[:, None]):
        assert float((x - x[0]).norm(dim=1).max()) < 1e-10 * float(x.norm(dim=1).max())


@pytest.mark.thorough
@pytest.mark.parametrize(("method", "steps", "drift"), [("generalized_alpha", 200, 1e-9), ("dopri5", 10, 1e-9)])
@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_the_spin_of_a_rod_between_two_ball_joints_does_not_drift(method, steps, drift, spin):
    """Nothing turns a round rod about its axis: om along it stays, though no joint holds it."""
    ground = mbd.Ground()
    crank = mbd.RigidBody("crank", 0.2, (1e-3, 1e-3, 1e-3), angular_velocity=(0.0, 0.0, 6.0))
    axes = turned(0.0, 0.6, 0.0)  # its x-axis points down and forward
    rod = mbd.RigidBody(
        "rod",
        0.3,
        (1e-5, 2e-3, 2e-3),
        position=tensor(0.1, 0.0, 0.0) + axes @ tensor(0.15, 0.0, 0.0),
        axes=axes,
        angular_velocity=(spin, 0.0, 0.0),
    )
    slider = mbd.RigidBody(
        "slider", 0.2, (1e-3, 1e-3, 1e-3), position=tensor(0.1, 0.0, 0.0) + axes @ tensor(0.3, 0.0, 0.0)
    )
    joints = [
        mbd.Revolute(ground.at(), crank.at(), axis="z"),
        mbd.Spherical(crank.at(0.1, 0.0, 0.0), rod.at(-0.15, 0.0, 0.0)),
        mbd.Spherical(rod.at(0.15, 0.0, 0.0), slider.at()),
        mbd.Prismatic(ground.at(), slider.at(), axis="x"),
    ]
    system = mbd.System([crank, rod, slider], joints, gravity=(0.0, 0.0, -9.81), stabilization=0.05)
    motion = mbd.simulate(system, 0.5, method, steps=steps).require_ok()
    om = motion.body("rod").omega[0]
    assert float(om[:, 1:].abs().max()) > 1.0
    assert float((om[:, 0] - om[0, 0]).abs().max()) < drift * float(om.abs().max())
    assert float(om[0, 0]) == pytest.approx(spin, abs=1e-9)
