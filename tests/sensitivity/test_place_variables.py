"""Points of joints and forces, and initial modal coordinates, as design variables."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, box, laminate, plate, tensor, turned
from tests.refused import refused
from tests.sensitivity.number_cases import GROUND, check, check_native, hung, number

V = mbd.variable
POINTS = ("hinge_a.x", "hinge_a.z", "tip_a.y", "spring_b.x", "push_a.z")


def mechanism() -> mbd.System:
    """A rigid arm on a hinge carries a soft plate and is pulled by a spring and a load; points of all vary."""
    tip, swing = tensor(0.2, 0.1, -0.05), turned(-0.5, 0.2, 0.9)
    arm = box("arm", position=(0.1, 0.05, -0.02), axes=turned(0.4, -0.7, 0.3), angular_velocity=(2.0, -1.0, 3.0))
    origin = arm.position + arm.axes @ tip - swing @ tensor(-0.15, 0.0, 0.0)
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), position=origin, axes=swing)
    foot = GROUND.at(V(0.1), 0.05, V(-0.02), axes=turned(0.2, 0.5, -0.4))
    joints = [
        mbd.Revolute(foot, arm.at(), axis="x", name="hinge"),
        mbd.Universal(arm.at(0.2, V(0.1), -0.05), rod.at("left"), axes="zx", name="tip"),
    ]
    forces = [
        mbd.SpringDamper(GROUND.at(), arm.at(V(0.1), 0.0, 0.02), stiffness=V(20.0), name="spring"),
        mbd.Force(arm.at(0.0, 0.1, V(0.05)), (0.3, -0.2, 0.1), name="push"),
    ]
    return mbd.System([arm, rod], joints, forces, gravity=GRAVITY)


def bent() -> mbd.System:
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT)).bent(
        nn.Parameter(tensor(1e-3, -4e-4)), nn.Parameter(tensor(0.1, 0.2))
    )
    return hung(rod)


def reacting(system: mbd.System, designs: dict[str, torch.Tensor], **options) -> torch.Tensor:
    """With the reaction at a point that varies."""
    motion = mbd.simulate(system, 0.02, steps=6, iterations=(8, 4), designs=designs, **options)
    result = motion.reaction("hinge")
    return (result.force.square().sum((1, 2)) + result.torque.square().sum((1, 2))) + number(system, designs, **options)


@pytest.mark.thorough
def test_gradients():
    check(mechanism(), [*POINTS, "spring.stiffness"], reacting)


@pytest.mark.thorough
def test_gradients_of_initial_modal_coordinates():
    check(bent(), ["rod.modal", "rod.modal_velocity"])


@pytest.mark.thorough
def test_both_backends(native):
    check_native(mechanism(), list(POINTS), reacting)
    check_native(bent(), ["rod.modal", "rod.modal_velocity"])


@pytest.mark.thorough
def test_transforms_of_torch_func():
    system = mechanism()
    x = system.get_parameter("tip_a.y").detach()

    def f(x: torch.Tensor) -> torch.Tensor:
        return number(system, {"tip_a.y": x})[0]

    assert_close(torch.func.jacfwd(f)(x), torch.func.jacrev(f)(x), rtol=1e-8, atol=0)


@pytest.mark.thorough
def test_a_design_is_a_system_of_its_own_and_a_point_has_one_place():
    """Of lanes, and of what was loaded; a body whose joint to the ground varies is not condensed."""
    system, own = mechanism(), mechanism()
    designs = {"hinge_a.x": tensor(0.1, 0.12), "spring_b.x": tensor(0.1, 0.2)}
    own.load_state_dict(own.state_dict() | {name: x[1] for name, x in designs.items()})
    both, alone = mbd.simulate(system, 0.02, steps=6, designs=designs), mbd.simulate(own, 0.02, steps=6)
    assert_close(both.q[1], alone.q[0], rtol=0, atol=1e-10)
    x = V(0.3)
    ball = mbd.RigidBody("ball", 1.0, (0.1, 0.1, 0.1))
    frames = [ball.at(x, 0.0, 0.0), ball.at(0.0, x, 0.0)]
    springs = [mbd.SpringDamper(GROUND.at(), f, stiffness=1.0, name=n) for f, n in zip(frames, "pq", strict=True)]
    shared = mbd.System([ball], forces=springs, free=["ball"])
    assert [name for name, _ in shared.named_parameters()] == ["p_b.x"]


def test_the_closed_form_of_a_pendulum():
    """At rest, level: its angular acceleration is g / l, l the distance of hinge and mass."""
    ball = mbd.RigidBody("ball", 2.0, (0.0, 0.0, 0.0), position=(0.5, 0.0, 0.0))
    hinge = mbd.Revolute(GROUND.at(), ball.at(V(-0.5), 0.0, 0.0), axis="z", name="hinge")
    system = mbd.System([ball], [hinge], gravity=(0.0, -9.81, 0.0))
    a = mbd.simulate(system, 1e-3, steps=2).body("ball").omega_rate[0, 0, 2]
    (by,) = torch.autograd.grad(a, system.get_parameter("hinge_b.x"))
    assert_close(a.detach(), tensor(-9.81 / 0.5)[0], rtol=1e-6, atol=0)
    assert_close(by, tensor(-9.81 / 0.25)[0], rtol=1e-6, atol=0)


def test_what_is_refused():
    ball = mbd.RigidBody("ball", 1.0, (0.1, 0.1, 0.1))
    rod = plate("rod")
    for make, path in (
        (lambda: ball.at(2.0 * V(0.1)), "ball.point"),
        (lambda: rod.at("left", offset=(V(0.1), 0.0, 0.0)), "offset"),
        (lambda: rod.bent((V(0.1), 0.0, 0.0)), "rod.modal"),
        (lambda: rod.bent((0.1,)), "rod.modal"),
    ):
        with refused(path):
            make()
    slide = mbd.Drive(GROUND.at(), ball.at(V(0.1)), axis="x", velocity=0.1)
    with refused("frame"):
        mbd.System([ball], [mbd.Prismatic(GROUND.at(), ball.at(), axis="x"), slide])
