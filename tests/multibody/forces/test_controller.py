"""Controllers: the motion of equivalent springs, exact gradients of weights and control histories, and what is refused."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.integrate.test_motion import differences
from tests.mechanisms import GRAVITY, SOFT, box, laminate, plate, tensor, turned
from torchmbd.multibody.equations import equations
from torchmbd.multibody.forces.signals import Actuator, Signal

pytestmark = pytest.mark.usefixtures("compiled")

S = mbd.signals
GROUND = mbd.Ground()


def linear(*rows: Sequence[float], bias: float | None = None) -> nn.Linear:
    module = nn.Linear(len(rows[0]), len(rows), bias=bias is not None, dtype=torch.float64)
    with torch.no_grad():
        module.weight.copy_(torch.tensor(rows, dtype=torch.float64))
        if bias is not None:
            module.bias.fill_(bias)
    return module


def network(inputs: int, outputs: int, width: int = 4) -> nn.Sequential:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return nn.Sequential(nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, outputs)).double()


def hinged() -> tuple[mbd.RigidBody, mbd.Revolute]:
    arm = box("arm", axes=turned(0.4, -0.7, 0.3))
    return arm, mbd.Revolute(GROUND.at(axes=turned(0.2, 0.5, -0.4)), arm.at(), axis="x", name="hinge")


def sliding() -> tuple[mbd.RigidBody, mbd.Prismatic]:
    cart = box("cart", axes=turned(0.4, -0.7, 0.3), velocity=tensor(1.0, 0.0, 0.0))
    return cart, mbd.Prismatic(GROUND.at(), cart.at(), axis="x", name="rail")


def flying() -> tuple[mbd.RigidBody, None]:
    return box("cart", position=(0.2, -0.1, 0.3), velocity=(1.0, 0.5, -0.3), angular_velocity=(1.0, 2.0, 0.5)), None


GAINS = (-20.0, -0.7)
CASES = {
    "hinge": (
        hinged,
        lambda body, joint: [
            mbd.Controller(linear(GAINS), [S.JointAngle(joint), S.JointRate(joint)], [S.JointTorque(joint)])
        ],
        lambda body, joint: [
            mbd.RotationalSpringDamper(
                joint.a, body.at(axes=body.axes.T @ joint.a.axes), "x", stiffness=20.0, damping=0.7
            )
        ],
    ),
    "rail": (
        sliding,
        lambda body, joint: [
            mbd.Controller(linear(GAINS), [S.JointTravel(joint), S.JointSpeed(joint)], [S.JointForce(joint)])
        ],
        lambda body, joint: [mbd.AxialSpringDamper(GROUND.at(), body.at(), "x", stiffness=20.0, damping=0.7)],
    ),
    "point": (
        flying,
        lambda body, joint: [
            mbd.Controller(
                linear((-20.0, 0.0, 0.0, -0.7, 0.0, 0.0), (0.0, 0.0, -20.0, 0.0, 0.0, -0.7)),
                [S.PointPosition(body.at(0.1, 0.0, 0.05)), S.PointVelocity(body.at(0.1, 0.0, 0.05))],
                [S.ForceOn(body.at(0.1, 0.0, 0.05), axis) for axis in "xz"],
            )
        ],
        lambda body, joint: [
            mbd.AxialSpringDamper(GROUND.at(), body.at(0.1, 0.0, 0.05), axis, stiffness=20.0, damping=0.7)
            for axis in "xz"
        ],
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
@pytest.mark.parametrize("case", CASES)
def test_the_motion_of_equivalent_springs(case, method):
    start, controlled, sprung = CASES[case]

    def run(forces) -> mbd.Trajectory:
        body, joint = start()
        system = mbd.System([body], [joint] if joint else [], forces(body, joint), gravity=GRAVITY)
        # Off the joint's rows, where stabilized equations drift by h^4, a torque and the force of an angle are not the same.
        steps = 40 if method == "generalized_alpha" else 150
        return mbd.simulate(system, 0.2, method, steps=steps, backend="eager", gradients="none").require_ok()

    result, expected = run(controlled), run(sprung)
    for name in ("q", "v", "a", "lam"):
        wanted = getattr(expected, name)
        size = float(wanted.abs().max()) if wanted.numel() else 0.0
        noise = 1e-9 if name == "a" else 1e-10  # accelerations carry the error of the iterations over h
        assert_close(getattr(result, name), wanted, rtol=0, atol=noise * max(size, 1.0))
    assert_close(result.energies.applied, expected.energies.applied, rtol=0, atol=1e-9)
    assert float(expected.energies.applied.abs().max()) > 1e-3


def arm(module: nn.Module | None = None, angles: Sequence[float] = (20.0, -50.0), damping: float = 0.0) -> mbd.System:
    """A soft flexible arm with a motor in its hinge, which sees all of its motion."""
    body = plate("rod", 2, made_of=laminate(angles, 3e-3, SOFT), axes=turned(0.0, 0.0, 0.4), damping=damping)
    hinge = mbd.Revolute(GROUND.at(), body.at("left"), axis="z", name="hinge")
    tip = body.at("right")
    inputs: list[Signal] = [
        S.JointAngle(hinge),
        S.JointRate(hinge),
        S.PointPosition(tip),
        S.PointVelocity(tip),
        S.Time(),
    ]
    outputs: list[Actuator] = [S.JointTorque(hinge), S.ForceOn(tip, "y", axes="frame")]
    control = mbd.Controller(module or network(9, 2), inputs, outputs)
    return mbd.System([body], [hinge], [control], gravity=GRAVITY)


def looked_at(motion: mbd.Trajectory) -> Tensor:
    """A number of all lanes [lanes]."""
    parts = (motion.q, 0.1 * motion.v, 1e-3 * motion.a, motion.body("rod").nodes)
    return sum((y * (1.0 + y)).flatten(1).sum(1) for y in parts)


OPTIONS = {"steps": 8, "iterations": (6, 4)}


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["controller.0.weight", "controller.2.bias"])
def test_gradients_of_weights(name):
    """By the adjoint, by tangents, by torch.func, and by differences."""
    system = arm()
    own = system.get_parameter(name)

    def f(x: Tensor, way: str = "auto") -> Tensor:
        return looked_at(mbd.simulate(system, 0.02, designs={name: x.reshape(own.shape)}, gradients=way, **OPTIONS))

    x = own.detach().flatten()[:4].clone()
    rest = own.detach().flatten()[4:]
    expected = differences(lambda y: f(torch.cat([y, rest]), "none"), x, 1e-2)[0]
    size = float(expected.abs().max())
    for way in ("reverse", "forward"):
        leaf = own.detach().clone().requires_grad_()
        f(leaf, way).sum().backward()
        assert_close(leaf.grad.flatten()[:4], expected, rtol=0, atol=1e-6 * size)
    pushed = torch.func.jvp(lambda y: f(torch.cat([y, rest])), (x,), (torch.ones_like(x),))[1]
    assert_close(pushed, expected.sum()[None], rtol=0, atol=1e-6 * size)


@pytest.mark.thorough
def test_backward_reaches_weights_and_angles():
    system = arm()
    looked_at(mbd.simulate(system, 0.02, **OPTIONS)).sum().backward()
    by_hand = {name: p.grad for name, p in system.named_parameters() if p.requires_grad}
    assert {"rod.laminate.angles", "controller.0.weight", "controller.0.bias", "controller.2.weight"} <= set(by_hand)
    assert all(g is not None and bool(g.abs().max() > 0.0) for g in by_hand.values())
    by_hand = {name: x.clone() for name, x in by_hand.items()}
    system.zero_grad()
    looked_at(mbd.simulate(system, 0.02, gradients="forward", **OPTIONS)).sum().backward()
    for name, x in by_hand.items():
        assert_close(system.get_parameter(name).grad, x, rtol=0, atol=1e-8 * float(x.abs().max()))


@pytest.mark.thorough
def test_many_weights():
    """Ten thousand: the slope of the loss along a direction, by one backward."""
    system = arm(network(9, 2, 850))
    weights = [p for name, p in system.named_parameters() if name.startswith("controller")]
    assert sum(p.numel() for p in weights) > 10_000
    looked_at(mbd.simulate(system, 0.01, steps=4, iterations=(6, 4))).sum().backward()
    direction = [p.grad / p.grad.norm() for p in weights]
    expected = sum(float((p.grad * d).sum()) for p, d in zip(weights, direction, strict=True))
    values = []
    with torch.no_grad():
        for step in (3e-4, -6e-4):
            for p, d in zip(weights, direction, strict=True):
                p += step * d
            values.append(float(looked_at(mbd.simulate(system, 0.01, steps=4, iterations=(6, 4))).sum()))
    assert (values[0] - values[1]) / 6e-4 == pytest.approx(expected, rel=1e-5)


@pytest.mark.thorough
def test_lanes_do_not_see_each_other():
    system = arm()
    make = torch.Generator().manual_seed(7)
    names = ("controller.0.weight", "rod.laminate.angles")
    own = [system.get_parameter(name).detach() for name in names]
    designs = {
        n: x + 0.2 * torch.randn(3, *x.shape, generator=make, dtype=x.dtype) for n, x in zip(names, own, strict=True)
    }
    designs = {name: x.requires_grad_() for name, x in designs.items()}
    both = mbd.simulate(system, 0.02, designs=designs, **OPTIONS)
    looked_at(both).sum().backward()
    for lane in range(3):
        one = {name: x.detach()[lane : lane + 1].clone().requires_grad_() for name, x in designs.items()}
        alone = mbd.simulate(system, 0.02, designs=one, **OPTIONS)
        assert_close(alone.q[0], both.q[lane], rtol=0, atol=1e-12)
        looked_at(alone).sum().backward()
        for name, x in one.items():
            assert_close(designs[name].grad[lane], x.grad[0], rtol=1e-7, atol=1e-9)
    shared = mbd.simulate(system, 0.02, designs={names[1]: designs[names[1]].detach()}, gradients="none", **OPTIONS)
    assert shared.status == ["ok"] * 3


@pytest.mark.thorough
def test_vmap_over_weights():
    system = arm()
    own = system.get_parameter("controller.2.bias").detach()

    def f(x: Tensor) -> Tensor:
        return looked_at(mbd.simulate(system, 0.02, designs={"controller.2.bias": x}, **OPTIONS))[0]

    many = torch.stack([own, own + 0.5])
    slopes = torch.stack([torch.func.jacrev(f)(x) for x in many])
    assert_close(torch.vmap(f)(many), torch.stack([f(x) for x in many]), rtol=1e-10, atol=0)
    assert_close(torch.vmap(torch.func.jacrev(f))(many), slopes, rtol=1e-7, atol=0)
    assert_close(torch.vmap(torch.func.jacfwd(f))(many), slopes, rtol=1e-7, atol=0)


class Steep(nn.Module):
    """Not finite once the time has come, where its weight is large."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(tensor(0.1)[0])

    def forward(self, x: Tensor) -> Tensor:
        return self.gain * torch.sqrt(0.021 - self.gain * x[:, -1:]).expand(-1, 2)


@pytest.mark.thorough
def test_a_lane_that_is_not_finite_fails_alone_and_is_named():
    system = arm(Steep())
    gains = tensor(0.1, 2.0).requires_grad_()
    motion = mbd.simulate(system, 0.02, steps=8, designs={"controller.gain": gains})
    assert motion.status[0] == "ok"
    motion.q[0].square().sum().backward()
    assert float(gains.grad[0].abs()) > 0.0
    assert float(gains.grad[1]) == 0.0
    assert "module Steep of the controller 'controller' is not finite near t = 0.0" in motion.status[1]


@pytest.mark.thorough
def test_the_iteration_matrix_knows_the_controller():
    """By rates and by coordinates, with gains that a matrix without them would not bear."""
    body, joint = hinged()
    module = linear((-1e5, -3e3))
    control = mbd.Controller(module, [S.JointAngle(joint), S.JointRate(joint)], [S.JointTorque(joint)])
    system = mbd.System([body], [joint], [control], gravity=GRAVITY)
    motion = mbd.simulate(system, 0.1, steps=20, gradients="none")
    assert motion.q.isfinite().all()
    assert motion.status[0].startswith("unresolved: ")  # four periods in a step
    assert float(motion.stats["iteration_error"]) < 1e-9


@pytest.mark.thorough
def test_training_of_a_network_and_of_ply_angles():
    """Adam on weights and angles together brings the tip nearer to where it is to be."""
    system = arm(network(9, 2, 6), damping=1e-3)
    goal, losses = tensor(0.25, 0.17, 0.015), []
    optimizer = torch.optim.Adam(system.parameters(), lr=0.03)
    before = {name: p.detach().clone() for name, p in system.named_parameters() if p.requires_grad}
    for _ in range(12):
        optimizer.zero_grad()
        motion = mbd.simulate(system, 0.08, steps=10)
        tip = motion.body("rod").nodes[0, -1, -1]
        loss = (tip - goal).square().sum()
        loss.backward()
        optimizer.step()
        losses.append(float(loss))
    assert losses[-1] < 0.1 * losses[0]
    assert all(bool((system.get_parameter(name) != x).any()) for name, x in before.items())


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["linear", "hold"])
def test_control_histories(kind):
    values = torch.randn(4, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    module = mbd.ControlHistory(values, 0.02, kind)
    times = torch.linspace(-0.002, 0.024, 53, dtype=torch.float64)
    result = torch.stack([module(t.reshape(1, 1))[0] for t in times]).detach().numpy()
    for k in range(2):
        if kind == "linear":
            expected = np.interp(times, np.linspace(0.0, 0.02, 4), values[:, k])
        else:
            sides = [values[(times / 0.005 + x).floor().clamp(0, 3).long(), k] for x in (-1e-9, 1e-9)]
            assert int((sides[0] != sides[1]).sum()) == 3  # samples at jumps: the mean of both sides
            expected = 0.5 * (sides[0] + sides[1])
        np.testing.assert_allclose(result[:, k], expected, rtol=0, atol=1e-14)

    body, joint = hinged()
    control = mbd.Controller(
        module, [S.Time()], [S.JointTorque(joint), S.ForceOn(body.at(0.1, 0.0, 0.0), "z")], "drive"
    )
    system = mbd.System([body], [joint], [control], gravity=GRAVITY)

    def f(x: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.02, designs={"drive.values": x.reshape(4, 2)}, **OPTIONS)
        return (motion.q * (1.0 + motion.q)).sum((1, 2)) + 0.1 * motion.v.square().sum((1, 2))

    x = values.flatten().clone().requires_grad_()
    expected = differences(f, values.flatten(), 1e-1)[0]
    (result,) = torch.autograd.grad(f(x).sum(), x)
    assert_close(result, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
    assert float(expected.abs().max()) > 1e-6


@pytest.mark.thorough
def test_phases():
    """Until an event, whose time depends on the weights, and then with the hinge locked."""
    body, joint = hinged()
    inputs = [S.JointAngle(joint), S.JointRate(joint), S.Time()]
    control = mbd.Controller(linear((3.0, 0.0, 5.0), bias=2.0), inputs, [S.JointTorque(joint)])
    system = mbd.System([body], [joint], [control])

    def f(x: Tensor) -> Tensor:
        event = mbd.Event(lambda motion: motion.body("arm").omega[..., 0] - 12.0)
        phases = [mbd.Phase(until=event), mbd.Phase(lock=["hinge"])]
        motion = mbd.simulate(
            system, 0.1, steps=100, designs={"controller.bias": x[None]}, phases=phases, iterations=(6, 4)
        )
        assert len(motion.require_ok().switches) == 1
        return 0.1 * motion.switches[0].t + (motion.q * (1.0 + motion.q)).mean((1, 2))

    x = tensor(2.0).requires_grad_()
    (result,) = torch.autograd.grad(f(x).sum(), x)
    assert_close(result, differences(f, tensor(2.0), 1e-2)[0], rtol=2e-3, atol=0)


@pytest.mark.thorough
def test_copies_and_files():
    system = arm()
    expected = mbd.simulate(system, 0.01, steps=4, gradients="none").q
    for other in (copy.deepcopy(system), pickle.loads(pickle.dumps(system))):
        assert torch.equal(mbd.simulate(other, 0.01, steps=4, gradients="none").q, expected)
        with torch.no_grad():
            other.get_parameter("controller.2.bias").add_(1.0)
        assert not torch.equal(mbd.simulate(other, 0.01, steps=4, gradients="none").q, expected)
    assert torch.equal(mbd.simulate(system, 0.01, steps=4, gradients="none").q, expected)
    other = arm(network(9, 2).requires_grad_(False))
    for p in other.get_submodule("controller").parameters():
        p.data.zero_()
    other.load_state_dict(system.state_dict())
    assert torch.equal(mbd.simulate(other, 0.01, steps=4, gradients="none").q, expected)


@pytest.mark.thorough
def test_signals_of_a_flexible_body():
    """Positions and velocities are those of the motion, the rate of the hinge is that of a difference of angles."""
    system = arm()
    motion = mbd.simulate(system, 0.02, gradients="none", **OPTIONS)
    T, data = system.topology, {name: x.detach() for name, x in system("data").items()}
    (link,) = T.links.each

    def read(q: Tensor, v: Tensor) -> Tensor:
        at = equations.placement(T, data, q, T.prescribed(motion.t[5], data))
        return T.links.signals(equations.action_states(T, data, at, v), motion.t[5])[link.read][:, 0, 0]

    q, v = (x[0, 5][:, None, None] for x in (motion.q, motion.v))
    x, tip = read(q, v), motion.body("rod").at("right")
    assert_close(x[2:5], tip.position[0, 5], rtol=0, atol=1e-12)
    assert_close(x[5:8], tip.velocity[0, 5], rtol=0, atol=1e-12)
    assert float(x[8]) == float(motion.t[5])
    h = 1e-6
    ahead, behind = (read(equations.advance(T, q, s * h * v), v)[0] for s in (1.0, -1.0))
    assert float(x[1]) == pytest.approx(float(ahead - behind) / (2.0 * h), rel=1e-6)


@pytest.mark.thorough
def test_shared_weights():
    """One module in two controllers, and one layer twice in a module: one parameter, whose gradient is of all its places."""
    layer = linear((0.3, -0.8), (0.9, 0.4))
    twice = nn.Sequential(layer, nn.Tanh(), layer)
    body, joint = hinged()
    inputs = [S.JointRate(joint), S.Time()]
    first = mbd.Controller(twice, inputs, [S.JointTorque(joint), S.ForceOn(body.at(0.1, 0.0, 0.0), "y")], "first")
    second = mbd.Controller(twice, inputs, [S.ForceOn(body.at(0.2, 0.1, 0.0), axis) for axis in "xz"], "second")
    system = mbd.System([body], [joint], [first, second], gravity=GRAVITY)
    (name,) = (name for name, _ in system.named_parameters())

    def f(x: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.05, designs={name: x.reshape(2, 2)}, **OPTIONS)
        return (motion.q * (1.0 + motion.q) + motion.v.sum(2, keepdim=True)).sum((1, 2))

    x = layer.weight.detach().flatten()
    expected = differences(f, x, 3e-3)[0]
    assert_close(torch.func.jacrev(f)(x)[0], expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
    assert_close(torch.func.jacfwd(f)(x)[0], expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
    before = layer.weight.clone()
    mbd.simulate(system, 0.05, **OPTIONS).v.sum().backward()
    assert layer.weight.grad is not None
    assert torch.equal(layer.weight, before)
