"""Code with loops against operators of torch: values, tangents, adjoint and the right-hand side of mechanisms of any kind."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from tests.extensions.native.test_steps import same
from tests.mechanisms import box, linked

pytestmark = pytest.mark.usefixtures("native")


def driven_chain() -> mbd.System:
    """A driven chain of three links closed by a bar of constant length, with laws of several forms, two of one form."""
    chain = linked(3, mbd.Revolute)
    ground, (first, second, third) = mbd.Ground(), chain.bodies
    weight = box("weight", position=(0.6, 0.5, 0.2))
    tip = third.at(0.1, 0.0, 0.0)
    joints = [
        *chain.joints,
        mbd.Drive(ground.at(), first.at("left"), angle=lambda t: 0.2 * torch.sin(20.0 * t), name="motor"),
        mbd.DistanceJoint(tip, weight.at(), (0.01 + 0.25 + 0.04) ** 0.5),
        mbd.PointOnPlane(ground.at(0.0, 0.5, 0.0), weight.at(), normal="y"),
    ]
    table = mbd.forces.Table(((-2.0, 1.0), (0.0, 0.2), (1.0, -1.0)), damping=0.02)
    forces = [
        mbd.SpringDamper(first.at("right"), weight.at(), stiffness=30.0, damping=0.2, name="one"),
        mbd.SpringDamper(second.at("right"), weight.at(0.01, 0.0, 0.0), stiffness=mbd.variable(50.0), name="two"),
        mbd.RotationalSpringDamper(first.at("right"), second.at("left"), law=table),
        mbd.Force(tip, (0.0, 1.0, 0.3)),
    ]
    return mbd.System([*chain.bodies, weight], joints, forces, gravity=(0.0, -9.81, 0.0))


def gradients(system: mbd.System, backend: str) -> dict[str, torch.Tensor]:
    """Of a number that everything goes into, by all parameters."""
    motion = mbd.simulate(system, 0.01, steps=20, backend=backend, iterations=(4, 3))
    assert motion.stats["backend"] == backend
    weights = torch.linspace(0.5, 1.5, motion.q.shape[-1], dtype=torch.float64)
    total = (motion.q * weights).square().sum() + 1e-3 * motion.v.square().sum() + 1e-6 * motion.a.square().sum()
    expected = {name: x for name, x in system.named_parameters() if x.requires_grad}
    return dict(zip(expected, torch.autograd.grad(total, list(expected.values())), strict=True))


@pytest.mark.thorough
@pytest.mark.parametrize("links", [2, 3, 7])
@pytest.mark.parametrize("joint", [mbd.Spherical, mbd.Universal])
def test_chains(links: int, joint: type) -> None:
    """Rigid and flexible links, tangents of two designs."""
    system = linked(links, joint)
    name = "link0.laminate.angles"
    designs = {name: system.body("link0").laminate.angles.detach() + torch.tensor([[0.0], [0.3]], dtype=torch.float64)}
    options = {"steps": 20, "designs": designs, "gradients": "forward", "variables": [name]}
    eager, fast = (mbd.simulate(system, 0.01, backend=backend, **options) for backend in ("eager", "native"))
    assert fast.stats["backend"] == "native"
    same(eager, fast)


@pytest.mark.thorough
@pytest.mark.parametrize("links", [2, 4])
def test_the_adjoint_of_chains(links: int) -> None:
    system = linked(links)
    expected, result = (gradients(system, backend) for backend in ("eager", "native"))
    for name, x in expected.items():
        torch.testing.assert_close(result[name], x, rtol=0, atol=1e-8 * float(x.abs().max()), msg=name)


@pytest.mark.thorough
def test_forces_and_closed_loops() -> None:
    system = driven_chain()
    eager, fast = (mbd.simulate(system, 0.01, steps=20, backend=backend) for backend in ("eager", "native"))
    same(eager, fast)
    expected, result = (gradients(system, backend) for backend in ("eager", "native"))
    for name, x in expected.items():
        torch.testing.assert_close(result[name], x, rtol=0, atol=1e-7 * float(x.abs().max()), msg=name)


@pytest.mark.thorough
def test_the_right_hand_side_of_a_chain() -> None:
    system = linked(4)
    eager, fast = (mbd.simulate(system, 1e-3, "rk4", 10, backend=backend) for backend in ("eager", "native"))
    same(eager, fast)


def test_a_body_without_joints() -> None:
    system = mbd.System([box("free", angular_velocity=(1.0, 2.0, 3.0))])
    eager, fast = (mbd.simulate(system, 0.1, steps=20, backend=backend) for backend in ("eager", "native"))
    same(eager, fast)
