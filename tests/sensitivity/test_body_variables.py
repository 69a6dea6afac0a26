"""Masses, inertia, centers, initial positions and velocities of bodies as design variables.

Two routes: the gradient in both modes, and Richardson differences of the motion.
"""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, INERTIA, SOFT, box, finished, laminate, plate, tensor, turned
from tests.refused import refused
from tests.sensitivity.number_cases import differences
from torchmbd.errors import InputError

pytestmark = pytest.mark.usefixtures("compiled")

WAYS = ("reverse", "forward")
STEPS = {"steps": 8, "iterations": (6, 4)}


def parameter(*x: float) -> nn.Parameter:
    return nn.Parameter(tensor(*x))


def mechanism() -> mbd.System:
    """A double pendulum of a rigid and a flexible body, and a free ball on a spring; no place is a special one."""
    ground, tip, swing = mbd.Ground(), tensor(0.2, 0.1, -0.05), turned(-0.5, 0.2, 0.9)
    arm = box(
        "arm",
        mass=mbd.variable(0.7),
        inertia=nn.Parameter(INERTIA.clone()),
        center=parameter(0.03, -0.02, 0.04),
        position=(0.1, 0.05, -0.02),
        axes=turned(0.4, -0.7, 0.3),
        angular_velocity=parameter(2.0, -1.0, 3.0),
    )
    rod = plate(
        "rod",
        2,
        made_of=laminate((20.0, -50.0), 3e-3, SOFT),
        position=nn.Parameter(arm.position + arm.axes @ tip - swing @ tensor(-0.15, 0.0, 0.0)),
        axes=swing,
        velocity=parameter(0.1, 0.2, 0.3),
        angular_velocity=parameter(1.0, 2.0, -2.0),
    )
    ball = mbd.RigidBody(
        "ball",
        mbd.variable(0.3),
        parameter(1e-3, 1.5e-3, 2e-3),
        position=parameter(0.4, 0.3, 0.2),
        velocity=parameter(0.1, -0.4, 0.2),
    )
    hinge = ground.at(0.1, 0.05, -0.02, axes=turned(0.2, 0.5, -0.4))
    joints = [mbd.Revolute(hinge, arm.at(), axis="x"), mbd.Universal(arm.at(*tip.tolist()), rod.at("left"), axes="zx")]
    spring = mbd.SpringDamper(rod.at("right"), ball.at(0.1, 0.0, 0.02), stiffness=20.0, name="spring")
    return mbd.System([arm, rod, ball], joints, [spring], gravity=GRAVITY)


def number(system: mbd.System, designs: dict[str, Tensor], **options) -> Tensor:
    """One that everything goes into [lanes]."""
    motion = finished(mbd.simulate(system, 0.01, designs=designs, **(STEPS | options)))
    reaction, energies = motion.reaction(system.joints[0].name).force, motion.energies
    parts = (motion.q, 0.1 * motion.v, 1e-3 * motion.a, 1e-3 * motion.lam, motion.body("rod").nodes)
    total = sum((y * (1.0 + y)).flatten(1).sum(1) for y in parts)
    return total + 1e-3 * reaction.square().sum((1, 2)) + energies.stored.sum(1) + energies.kinetic.sum(1)


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return mechanism()


@pytest.fixture(scope="module")
def start(system) -> dict[str, Tensor]:
    return {k: x.detach().clone() for k, x in system.named_parameters() if "laminate" not in k}


@pytest.fixture(scope="module")
def slopes(system, start) -> dict[str, Tensor]:
    return differences(lambda designs: number(system, designs), system, list(start))


def test_their_names(system):
    own = {name for name, _ in system.named_parameters()}
    assert own == {
        *(f"arm.{x}" for x in ("mass", "inertia", "center", "angular_velocity")),
        *(f"rod.{x}" for x in ("position", "velocity", "angular_velocity", "laminate.angles", "laminate.thickness")),
        *(f"ball.{x}" for x in ("mass", "inertia", "position", "velocity")),
    }


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_gradients(system, start, slopes, way):
    x = {name: y.clone().requires_grad_() for name, y in start.items()}
    number(system, x, gradients=way).sum().backward()
    for name, expected in slopes.items():
        assert_close(x[name].grad, expected, rtol=0, atol=2e-6 * float(expected.abs().max()), msg=name)


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_lanes_are_designs_of_their_own(system, start, way):
    many = {name: torch.stack([y, 1.01 * y]).requires_grad_() for name, y in start.items()}
    number(system, many, gradients=way).sum().backward()
    one = {name: y.detach()[1].clone().requires_grad_() for name, y in many.items()}
    number(system, one, gradients=way).sum().backward()
    for name, x in one.items():
        assert_close(many[name].grad[1], x.grad, rtol=0, atol=1e-8 * float(x.grad.abs().max()), msg=name)


@pytest.mark.thorough
def test_transforms_of_torch_func(system, start, slopes):
    for name in ("ball.velocity", "ball.mass", "rod.position"):

        def f(x: Tensor, name: str = name) -> Tensor:
            return number(system, {name: x})[0]

        size = float(slopes[name].abs().max())
        for transform in (torch.func.jacfwd, torch.func.jacrev):
            assert_close(transform(f)(start[name]), slopes[name], rtol=0, atol=2e-6 * size, msg=name)


@pytest.mark.thorough
def test_compiled_steps_have_the_same_gradients(system, start, native):
    result = []
    for backend in ("eager", "native"):
        x = {name: torch.stack([y, 1.01 * y]).requires_grad_() for name, y in start.items()}
        number(system, x, gradients="reverse", backend=backend).sum().backward()
        result.append({name: y.grad for name, y in x.items()})
    for name, x in result[0].items():
        assert_close(result[1][name], x, rtol=0, atol=1e-7 * float(x.abs().max()), msg=name)


@pytest.mark.thorough
def test_phases_and_methods_of_torchdiffeq(system, start):
    """By forward mode; phases that change nothing, against the same without phases."""
    name = "ball.velocity"
    for options in ({"phases": [mbd.Phase(until=0.005), mbd.Phase()]}, {"method": "rk4", "steps": 40}):
        given = {k: x for k, x in options.items() if k != "steps"}
        steps = {"steps": 40} if "method" in options else {"steps": 8}

        def f(x: Tensor, given=given, steps=steps) -> Tensor:
            motion = mbd.simulate(system, 0.01, designs={name: x}, **steps, **given)
            return (motion.q * (1.0 + motion.q)).sum((1, 2))[0]

        result = torch.func.jacfwd(f)(start[name])
        with torch.no_grad():
            e, h = torch.eye(3, dtype=torch.float64), 1e-4
            expected = torch.stack([(f(start[name] + h * d) - f(start[name] - h * d)) / (2.0 * h) for d in e])
        assert_close(result, expected, rtol=0, atol=2e-6 * float(expected.abs().max()))


@pytest.mark.thorough
def test_a_mass_that_falls_and_a_ball_that_flies():
    """Closed forms: m g on its hinge; r = r0 + v0 t, by a second order method exactly."""
    ground, m, g = mbd.Ground(), mbd.variable(2.0), 9.81
    post = mbd.RigidBody("post", m, (1.0, 1.0, 1.0))
    held = mbd.System([post], [mbd.Fixed(ground.at(), post.at())], gravity=(0.0, 0.0, -g))
    force = mbd.simulate(held, 0.1, steps=4).reaction(held.joints[0].name).force[0, -1]
    (slope,) = torch.autograd.grad(force[2], m)
    assert_close(slope.abs(), tensor(g)[0], rtol=1e-12, atol=0)
    r0, v0 = parameter(1.0, 2.0, 3.0), parameter(0.3, -0.1, 0.2)
    ball = mbd.RigidBody("ball", 1.0, (1.0, 1.0, 1.0), position=r0, velocity=v0)
    end = mbd.simulate(mbd.System([ball], free=["ball"]), 0.5, steps=5).body("ball").r[0, -1]
    for k in range(3):
        by = torch.autograd.grad(end[k], (r0, v0), retain_graph=True)
        e = torch.eye(3, dtype=torch.float64)[k]
        assert_close(by, (e, 0.5 * e), rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
def test_they_are_trained_saved_and_copied(system):
    again = copy.deepcopy(system)
    values = {name: x + 0.01 for name, x in system.state_dict().items() if name in ("ball.mass", "ball.velocity")}
    again.load_state_dict(system.state_dict() | values)
    other = pickle.loads(pickle.dumps(again))
    for result in (again, other):
        assert_close(result.get_parameter("ball.mass"), system.get_parameter("ball.mass") + 0.01)
        assert_close(number(result, {}), number(system, values), rtol=1e-9, atol=0)
    optimizer, seen = torch.optim.Adam(again.parameters(), lr=1e-7), []
    for _ in range(3):
        optimizer.zero_grad()
        loss = number(again, {}).sum()
        loss.backward()
        optimizer.step()
        seen.append(float(loss.detach()))
    assert seen[2] < seen[1] < seen[0]


def test_what_no_parameter_can_be_is_refused_by_name():
    body = ("b", 1.0, (1.0, 1.0, 1.0))
    cases = {
        "b.mass has a gradient": lambda: mbd.RigidBody("b", 2.0 * mbd.variable(1.0), body[2]),
        "b.mass is a Parameter of shape": lambda: mbd.RigidBody("b", parameter(1.0), body[2]),
        "b.velocity": lambda: mbd.RigidBody(*body, velocity=parameter(1.0, 2.0)),
        "Parameter of torch.float32": lambda: mbd.RigidBody(*body, velocity=nn.Parameter(torch.zeros(3))),
        "b.axes has a gradient": lambda: mbd.RigidBody(*body, axes=nn.Parameter(torch.eye(3, dtype=torch.float64))),
        "b.inertia": lambda: mbd.RigidBody("b", 1.0, parameter(1.0, 1.0, 5.0)),
        "b.point has a gradient": lambda: mbd.RigidBody(*body).at(2.0 * mbd.variable(0.1)),
    }
    for message, make in cases.items():
        with pytest.raises(InputError, match=message):
            make()
    with refused("b.mass"):
        mbd.RigidBody("b", mbd.variable(-1.0), body[2])
    slider = mbd.RigidBody(*body, position=parameter(0.0, 0.0, 0.0))
    slide = mbd.Drive(mbd.Ground().at(), slider.at(), axis="x", velocity=0.1)
    joint = mbd.Prismatic(mbd.Ground().at(), slider.at(), axis="x")
    with refused("b.position"):
        mbd.System([slider], [joint, slide])


def test_designs_with_no_mass_are_refused(system):
    with refused("ball.mass", -1.0):
        mbd.simulate(system, 0.01, designs={"ball.mass": tensor(1.0, -1.0)})
