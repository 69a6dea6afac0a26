"""Reactions of joints: every body is in equilibrium under them, its weight and its inertia, whatever the joints are."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import INERTIA, SOFT, box, laminate, pendulum, plate, tensor, turned
from tests.refused import refused
from torchmbd.results.reaction import frame_axes, frame_point

GRAVITY = tensor(1.5, -9.0, 3.5)


def cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=-1)


def wrench(motion: mbd.Trajectory, name: str, sign: float) -> tuple[Tensor, Tensor]:
    """Force, and torque about the origin of the ground, on the second body (sign 1) or the first (-1) [times, 3]."""
    joint = next(joint for joint in motion.system.joints if joint.name == name)
    result = motion.reaction(name)
    axes, at = frame_axes(motion, joint.a), frame_point(motion, joint.a)
    f, m = (sign * torch.einsum("ltij,ltj->lti", axes, x) for x in (result.force, result.torque))
    return f[0], (m + cross(at, f))[0]


def inertia_of(motion: mbd.Trajectory, name: str) -> tuple[Tensor, Tensor]:
    """m (a - g), and the rate of the angular momentum less the moment of the weight, about the origin of the ground."""
    body = motion.system.body(name)
    view = motion.body(name)
    at = view.at(body.center.tolist())
    f = float(body.mass) * (at.acceleration - GRAVITY)[0]
    J, om, turn = INERTIA, view.omega[0], view.omega_rate[0]
    spin = torch.einsum("tij,tj->ti", view.A[0], turn @ J + cross(om, om @ J))
    return f, spin + cross(at.position[0], f)


def three_boxes() -> mbd.System:
    """A tree of every kind of joint in general position, a drive on its root and a travelling one on a guide."""
    ground = mbd.Ground()
    a = box("a", position=(0.1, 0.0, 0.2), axes=turned(0.2, -0.3, 0.5))
    b = box("b", position=(0.4, 0.1, 0.1), axes=turned(-0.4, 0.2, 0.1))
    c = box("c", position=(0.6, 0.4, -0.1), axes=turned(0.1, 0.6, -0.2), angular_velocity=(3.0, -1.0, 2.0))

    def meet(x: mbd.RigidBody, y: mbd.RigidBody, *place: float):
        g, axes = tensor(*place), turned(0.7, 0.1, -0.6)
        return (z.at(*(z.axes.T @ (g - z.position)).tolist(), axes=z.axes.T @ axes) for z in (x, y))

    hinge, guide = list(meet(a, b, 0.25, 0.05, 0.15)), list(meet(b, c, 0.5, 0.25, 0.0))
    root = ground.at(0.1, 0.0, 0.2, axes=turned(-0.2, 0.9, 0.3))
    return mbd.System(
        [a, b, c],
        [
            mbd.Universal(root, a.at(), "xy", name="root"),
            mbd.Revolute(*hinge, axis="y", name="hinge"),
            mbd.Drive(*hinge, axis="y", angle=mbd.Sine(0.4, 1.5), name="motor"),
            mbd.Cylindrical(*guide, axis="z", name="guide"),
            mbd.Drive(*guide, axis="z", position=mbd.Sine(0.1, 1.0), name="pusher"),
        ],
        gravity=GRAVITY,
    )


@pytest.fixture(scope="module")
def boxes() -> mbd.Trajectory:
    return mbd.simulate(three_boxes(), 0.05, steps=100, spectral_radius=0.6, iterations=(5, 5)).require_ok()


@pytest.mark.parametrize(
    ("body", "on", "by"),
    [
        ("a", ["root"], ["hinge", "motor"]),
        ("b", ["hinge", "motor"], ["guide", "pusher"]),
        ("c", ["guide", "pusher"], []),
    ],
)
def test_free_bodies_are_in_equilibrium(boxes, body, on, by):
    wrenches = [wrench(boxes, name, sign) for names, sign in ((on, 1.0), (by, -1.0)) for name in names]
    for part in range(2):
        total, expected = sum(w[part] for w in wrenches), inertia_of(boxes, body)[part]
        assert_close(total, expected, rtol=0, atol=1e-7 * float(expected.abs().max()))


def test_reactions_lie_where_the_joint_resists(boxes):
    hinge, motor, pusher = (boxes.reaction(name) for name in ("hinge", "motor", "pusher"))
    size = float(hinge.torque.abs().max())
    assert float(hinge.torque[..., 1].abs().max()) < 1e-7 * size  # free about its axis y
    assert float(hinge.torque[..., [0, 2]].abs().max()) == size
    assert float(motor.force.abs().max()) == 0.0
    assert float(motor.torque[..., [0, 2]].abs().max()) < 1e-10 * float(motor.torque.abs().max())
    assert float(pusher.force[..., :2].abs().max()) < 1e-10 * float(pusher.force.abs().max())


@pytest.mark.thorough
def test_a_plate_at_rest_on_an_arm_weighs_on_its_joint():
    """A clamped panel that has come to rest: force m g, torque m c x g, with the bent center of mass, on a set of nodes."""
    body = plate("panel", modes=3, cells=(4, 2), axes=turned(0.3, 0.2, 0.4), damping=0.02)
    frame = body.at("left_edge", offset=(-0.1, 0.02, 0.05), axes=turned(0.1, 0.5, 0.2))
    ground = mbd.Ground().at(*(body.axes @ frame.point).tolist(), axes=turned(0.4, -0.1, 0.8))
    system = mbd.System([body], [mbd.Fixed(ground, frame, name="clamp")], gravity=GRAVITY)
    # Does not resolve how it comes to rest.
    motion = mbd.simulate(system, 3.0, steps=150, spectral_radius=0.0, halvings=0)
    mass = motion.body("panel").mass[0]
    points = system.body("panel").assembly.masses().mass.detach()
    center = (points @ motion.body("panel").nodes[0, -1]) / points.sum()
    result = motion.reaction("clamp")
    f, m = (ground.axes @ x[0, -1] for x in (result.force, result.torque))
    assert_close(f, -mass * GRAVITY, rtol=0, atol=1e-6 * float(mass * 9.7))
    assert_close(m, -mass * cross(center - ground.point, GRAVITY), rtol=0, atol=2e-6 * float(mass * 9.7))


@pytest.mark.thorough
def test_the_other_body_feels_the_opposite():
    motion = mbd.simulate(pendulum(), 0.02, steps=40).require_ok()
    (first, second) = motion.system.joints
    at = frame_point(motion, second.a)
    for name, joint in ((first.name, first), (second.name, second)):
        result = motion.reaction(name)
        force = mbd.Reaction(name, (0.3, -0.2, 0.5), on=joint.a.body.name)
        if joint.a.body.name != "ground":
            e = tensor(0.3, -0.2, 0.5) / tensor(0.3, -0.2, 0.5).norm()
            ground = torch.einsum("ltij,ltj->lti", frame_axes(motion, joint.a), result.force)
            assert_close(force.values(motion), -ground @ e, rtol=1e-12, atol=1e-12)
    assert at.shape == (1, 41, 3)


def test_a_joint_that_does_not_exist(boxes):
    with refused("joint", "higne", meant="hinge"):
        boxes.reaction("higne")


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["none", "reverse", "forward"])
def test_a_locked_joint_transmits_the_moment_of_the_lock(gradients):
    """m g c about the axis while the phase locks the hinge, then none; about the other body the opposite."""
    bob = mbd.RigidBody("bob", mbd.variable(2.0), (0.01, 0.02, 0.03), center=(0.5, 0.0, 0.0))
    system = mbd.System(
        [bob], [mbd.Revolute(mbd.Ground().at(), bob.at(), axis="z", name="hinge")], gravity=(0, -10.0, 0)
    )
    phases = [mbd.Phase(lasting=0.1, lock=["hinge"]), mbd.Phase(lasting=0.05), mbd.Phase(lock=["hinge"])]
    motion = mbd.simulate(system, 0.2, steps=40, phases=phases, gradients=gradients).require_ok()
    torque = motion.reaction("hinge").torque[0, :, 2]
    assert_close(torque[motion.t < 0.0999], tensor(10.0).expand(20), rtol=1e-9, atol=0)
    assert_close(torque[(motion.t > 0.1) & (motion.t < 0.1499)], torch.zeros(9, dtype=torch.float64), rtol=0, atol=1e-9)
    assert float(torque[-1].abs()) > 1.0
    measure = mbd.Max(mbd.Reaction("hinge", "z", kind="torque"), window=(0.0, 0.1))
    other = mbd.Min(mbd.Reaction("hinge", "z", kind="torque", on="ground"), window=(0.0, 0.1))
    assert float(measure(motion)) == pytest.approx(10.0, rel=1e-9)
    assert float(other(motion)) == pytest.approx(-10.0, rel=1e-9)
    if gradients != "none":
        assert float(measure.value_and_gradient(motion)[1]) == pytest.approx(5.0, rel=1e-8)


@pytest.mark.thorough
def test_axes_on_a_bent_body_turn_with_its_nodes():
    """A load on the end of a soft plate: its joint keeps both frames parallel, but for squares of the angle by which the end
    turns, since attached axes turn to first order; those of the rigid load are known."""
    ground, rod = mbd.Ground(), plate("rod", made_of=laminate((20.0, -50.0), 3e-3, SOFT))
    load = box("load", position=(0.3, 0.0, 0.0))
    turn = turned(0.4, -0.2, 0.3)
    joints = [
        mbd.Fixed(ground.at(), rod.at("left"), name="root"),
        mbd.Fixed(rod.at("right", axes=turn), load.at(axes=turn), name="hook"),
    ]
    motion = mbd.simulate(mbd.System([rod, load], joints, gravity=GRAVITY), 0.05, steps=50).require_ok()
    view = motion.body("load")
    force, _ = inertia_of(motion, "load")
    angle = (view.A[0] - torch.eye(3, dtype=torch.float64)).abs().amax()
    assert 0.01 < float(angle) < 0.1
    axes = view.A[0] @ load.at(axes=turn).axes
    assert_close(
        motion.reaction("hook").force[0],
        torch.einsum("tij,ti->tj", axes, force),
        rtol=0,
        atol=float(force.abs().amax() * angle**2),
    )


@pytest.mark.parametrize("phases", [None, [mbd.Phase(until=0.02), mbd.Phase(lock=["second"])], [mbd.Phase()]])
def test_loads_that_equilibrium_does_not_determine_are_told_with_phases_too(phases):
    """Two hinges on one axis are over-constrained in every part of the motion in which both act. One hinge alone is not."""
    arm = box("arm")
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(0, 0, z), arm.at(0, 0, z), name=name) for name, z in (("first", 0.0), ("second", 0.2))
    ]
    motion = mbd.simulate(mbd.System([arm], joints), 0.05, steps=10, phases=phases, gradients="none")
    with pytest.warns(UserWarning, match="over-constraint"):
        motion.reaction("first")
    released = [mbd.Phase(until=0.02, release=["second"]), mbd.Phase(release=["second"])]
    alone = mbd.simulate(mbd.System([arm], joints), 0.05, steps=10, phases=released, gradients="none")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone.reaction("first")
