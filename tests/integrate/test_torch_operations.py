"""Every output of a motion by every kind of parameter at once: reverse mode is the transpose of forward mode."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, laminate, pendulum, plate, tensor

DURATION = 0.01
OUTPUTS = {
    "q": lambda m: m.q,
    "v": lambda m: m.v,
    "a": lambda m: 1e-3 * m.a,
    "lam": lambda m: m.lam,
    "nodes": lambda m: m.body("rod").nodes,
    "reaction": lambda m: m.reaction(m.system.joints[0].name).torque,
    "kinetic": lambda m: m.energies.kinetic,
    "stored": lambda m: m.energies.stored,
    "dissipated": lambda m: m.energies.dissipated,
    "response": lambda m: mbd.Max(mbd.StrainEnergy("rod"))(m),
}


@pytest.fixture(scope="module")
def system() -> mbd.System:
    """Angles, thickness, a spring, a mass, a center, an initial velocity: parameters of all kinds."""
    ground = mbd.Ground()
    rod = plate(
        "rod",
        2,
        made_of=laminate((20.0, -50.0), 3e-3, SOFT),
        position=(0.3, 0.0, 0.0),
        angular_velocity=torch.nn.Parameter(tensor(0.0, 2.0, 0.0)),
    ).damped(0.02)
    weight = mbd.RigidBody(
        "weight", mbd.variable(0.2), (1e-3, 2e-3, 2e-3), center=torch.nn.Parameter(tensor(0.01, 0.02, -0.01))
    )
    frame = rod.at("right")
    weight.position.copy_(rod.position + frame.point)
    joints = [mbd.Revolute(ground.at(0.15, 0.0, 0.0), rod.at("left"), axis="y"), mbd.Spherical(frame, weight.at())]
    spring = mbd.SpringDamper(
        ground.at(0.1, 0.2, 0.3), weight.at(), stiffness=mbd.variable(30.0), damping=0.1, rest=0.1, name="spring"
    )
    return mbd.System([rod, weight], joints, [spring], gravity=GRAVITY)


@pytest.fixture(scope="module")
def inputs(system) -> dict[str, Tensor]:
    own = {name: x.detach().clone() for name, x in system.named_parameters()}
    return own | {"duration": torch.tensor(DURATION, dtype=torch.float64)}


def outputs(system: mbd.System, given: dict[str, Tensor]) -> dict[str, Tensor]:
    designs = {name: x for name, x in given.items() if name != "duration"}
    motion = mbd.simulate(system, given["duration"], steps=8, designs=designs, iterations=(6, 4))
    assert motion.ok
    return {name: (x * (1.0 + x)).sum() for name, x in ((name, f(motion)) for name, f in OUTPUTS.items())}


@pytest.mark.thorough
def test_reverse_mode_is_the_transpose_of_forward_mode(system, inputs):
    make = torch.Generator().manual_seed(5)
    directions = {
        name: float(x.abs().max()) * torch.randn(x.shape, generator=make, dtype=x.dtype) for name, x in inputs.items()
    }
    slopes = torch.func.jvp(lambda x: outputs(system, x), (inputs,), (directions,))[1]
    x = {name: y.clone().requires_grad_() for name, y in inputs.items()}
    result = outputs(system, x)
    for name, y in result.items():
        for leaf in x.values():
            leaf.grad = None
        y.backward(retain_graph=True)
        parts = {k: (leaf.grad * directions[k]).sum() for k, leaf in x.items()}
        assert all(float(part) != 0.0 for part in parts.values()), (name, parts)
        size = sum(float(part.abs()) for part in parts.values())
        assert_close(sum(parts.values()), slopes[name], rtol=0, atol=1e-7 * size, msg=name)


@pytest.mark.thorough
def test_backward_fills_the_gradients_of_the_parameters_themselves(system, inputs):
    """As with the same numbers given as designs."""
    x = {name: y.clone().requires_grad_() for name, y in inputs.items()}
    outputs(system, x)["nodes"].backward()
    system.zero_grad()
    for own in system.parameters():
        own.requires_grad_()
    outputs(system, {"duration": inputs["duration"]})["nodes"].backward()
    for name, own in system.named_parameters():
        assert_close(own.grad, x[name].grad, rtol=1e-9, atol=0, msg=name)


@pytest.mark.thorough
def test_a_response_that_depends_on_no_parameter_has_a_gradient_of_zero():
    system = pendulum()
    motion = mbd.simulate(system, DURATION, steps=8)
    for measure in (mbd.measure(lambda motion: torch.ones(motion.lanes, dtype=torch.float64)), mbd.Mass("arm")):
        result = measure.of(motion)
        assert result.gradient is not None
        assert result.gradient.tolist() == [[0.0, 0.0]]
        (slope,) = torch.autograd.grad(measure(motion).sum(), system.get_parameter("rod.laminate.angles"))
        assert slope.tolist() == [0.0, 0.0]
    with torch.no_grad():
        assert not measure(motion).requires_grad


def falls(motion: mbd.Trajectory) -> Tensor:
    return motion.body("rod").r[..., 2] - HEIGHT


HEIGHT = float(pendulum().body("rod").position[2]) - 3e-4


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["reverse", "forward"])
def test_motions_through_phases_are_copied_and_pickled(gradients):
    """Where a function of an event is a lambda, pickle says so; it copies as any other."""
    system = pendulum()
    for event in (falls, lambda motion: falls(motion)):
        phases = [mbd.Phase(until=mbd.Event(event)), mbd.Phase(lock=[system.joints[0]])]
        motion = mbd.simulate(system, DURATION, steps=8, phases=phases, gradients=gradients)
        assert torch.equal(copy.deepcopy(motion).q, motion.q.detach())
        if event is falls:
            again = pickle.loads(pickle.dumps(motion))
            assert torch.equal(again.lam, motion.lam.detach())
            assert torch.equal(again.switches[0].t, motion.switches[0].t.detach())
        else:
            with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
                pickle.dumps(motion)
