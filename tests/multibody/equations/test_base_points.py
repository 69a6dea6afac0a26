"""The origins of rigid bodies do not change the motion."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd

INERTIA = (0.01, 0.02, 0.03)
AXES = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]


def double_pendulum(arm: tuple[float, float, float], phases: bool = False) -> mbd.System:
    """A double pendulum: both bodies have their center of mass at `arm` from their origin, and body b has turned axes."""
    c, ground = torch.tensor(arm, dtype=torch.float64), mbd.Ground()
    turned = c @ torch.tensor(AXES, dtype=torch.float64).T

    def at(body: mbd.RigidBody, x: float, y: float) -> mbd.Frame:
        return body.at(*(c + torch.tensor([x, y, 0.0], dtype=torch.float64)).tolist())

    a = mbd.RigidBody(
        "a", mbd.variable(1.0), INERTIA, torch.nn.Parameter(c.clone()), (torch.tensor([0.5, 0, 0]) - c).tolist()
    )
    start = (torch.tensor([1.5, 0, 0]) - turned).tolist()
    b = mbd.RigidBody("b", 1.0, INERTIA, c.tolist(), start, AXES)
    joints: list[Any] = [
        mbd.Revolute(ground.at(), at(a, -0.5, 0.0), axis="z", name="hinge"),
        mbd.Revolute(
            at(a, 0.5, 0.0), b.at(c[0].item(), mbd.variable(c[1].item() + 0.5), c[2].item()), axis="z", name="elbow"
        ),
    ]
    if phases:
        joints.append(mbd.Spherical(ground.at(1.5, 0, 0), at(b, 0.0, 0.0), name="hook"))
    return mbd.System([a, b], joints, gravity=(0.0, -9.81, 0.0))


def shown(motion: mbd.Trajectory, arm: tuple[float, float, float]) -> list[Tensor]:
    """The motion of the center of b, and the reactions [lanes, times, 3]."""
    b = motion.body("b").at(arm)
    reactions = [motion.reaction(name) for name in ("hinge", "elbow")]
    return [b.position, b.velocity, b.acceleration, *(x for r in reactions for x in (r.force, r.torque))]


@pytest.mark.parametrize("gradients", ["forward", "reverse"])
@pytest.mark.parametrize("phases", [False, True])
@pytest.mark.thorough
def test_origins_do_not_change_motions_reactions_and_gradients(gradients: str, phases: bool):
    results = []
    for arm in ((0.0, 0.0, 0.0), (10.0, -4.0, 3.0)):
        system = double_pendulum(arm, phases)
        names = ["a.mass", "a.center", "elbow_b.y"]
        designs = {n: x.detach()[None].requires_grad_() for n, x in system.named_parameters() if n in names}
        assert designs.keys() == set(names)
        options: dict[str, Any] = {"phases": [mbd.Phase(until=0.04), mbd.Phase(release=["hook"])]} if phases else {}
        motion = mbd.simulate(system, 0.1, steps=20, designs=designs, gradients=gradients, **options).require_ok()
        numbers = shown(motion, arm)
        total = torch.stack([(0.1 * x).square().sum() for x in numbers]).sum()
        results.append([x.detach() for x in numbers] + list(torch.autograd.grad(total, [designs[n] for n in names])))
    for near, far in zip(*results, strict=True):
        assert_close(far, near, rtol=1e-7, atol=1e-8)


def test_results_show_the_origin_of_a_body():
    arm = (10.0, -4.0, 3.0)
    near, far = (mbd.simulate(double_pendulum(c), 0.05, steps=10, gradients="none") for c in ((0.0, 0.0, 0.0), arm))
    point, body = near.body("b").at([-x for x in arm]), far.body("b")
    assert_close(body.r, point.position, rtol=0, atol=1e-10)
    assert_close(body.velocity, point.velocity, rtol=0, atol=1e-9)
    assert_close(body.at().acceleration, point.acceleration, rtol=1e-8, atol=1e-8)
    assert_close(far.energies.stored, near.energies.stored, rtol=0, atol=1e-9)


def test_given_velocities_are_those_of_the_origin():
    free = mbd.RigidBody(
        "free", 1.0, INERTIA, (5.0, 0.0, 0.0), velocity=(1.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 2.0), axes=AXES
    )
    body = mbd.simulate(mbd.System([free]), 0.01, steps=4, gradients="none").body("free")
    assert_close(body.r[0, 0], torch.zeros(3, dtype=torch.float64))
    assert_close(body.velocity[0, 0], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    assert_close(body.at((5.0, 0.0, 0.0)).velocity[0, 0], torch.tensor([-9.0, 0.0, 0.0], dtype=torch.float64))
    guided = mbd.RigidBody("guided", 1.0, INERTIA, (5.0, 0.0, 0.0), velocity=(1.0, 0.0, 0.0))
    drive = mbd.Drive(mbd.Ground(), guided, axis="z", speed=2.0)
    motion = mbd.simulate(mbd.System([guided], [drive]), 0.01, steps=4, gradients="none")
    assert_close(motion.body("guided").velocity[0, 0], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))


def test_a_motion_goes_on_in_a_system_with_other_origins():
    arm = (10.0, -4.0, 3.0)
    near, far = double_pendulum((0.0, 0.0, 0.0)), double_pendulum(arm)
    first = mbd.simulate(far, 0.05, steps=10, gradients="none").require_ok()
    again = mbd.simulate(far, 0.05, steps=10, start=first, gradients="none")
    expected = mbd.simulate(near, 0.05, steps=10, start=mbd.simulate(near, 0.05, steps=10), gradients="none")
    x, y = again.body("b").at(arm).position, expected.body("b").at((0.0, 0.0, 0.0)).position
    assert_close(x, y, rtol=0, atol=1e-6)  # velocities of a state miss the joints by errors of its steps


def test_an_origin_in_a_hinge_of_the_ground_stays():
    """Its hinge leaves one unknown."""
    bob = mbd.RigidBody("bob", 1.0, INERTIA, (0.0, -10.0, 0.0))
    system = mbd.System([bob], [mbd.Revolute(mbd.Ground().at(), bob.at(), axis="z")], gravity=(0.0, -9.81, 0.0))
    assert system.topology.base_points is None
    assert system.dynamics().condensed().topology.n_v == 1
