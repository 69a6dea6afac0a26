"""`system()` is a torch module: torchdiffeq, functional_call, copies and moves work on it, or are refused in one sentence."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
import torchdiffeq
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, laminate, pendulum, plate
from tests.refused import ANY, refused

ANGLES, STIFFNESS = "rod.laminate.angles", "spring.stiffness"
END = 0.002
TIMES = torch.linspace(0.0, END, 3, dtype=torch.float64)
TIGHT = {"rtol": 1e-9, "atol": 1e-11}


def hung() -> mbd.System:
    ground, rod = mbd.Ground(), plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), position=(0.3, 0.0, 0.0))
    spring = mbd.SpringDamper(
        ground.at(0.1, 0.2, 0.3), rod.at("right"), stiffness=mbd.variable(30.0), rest=0.1, name="spring"
    )
    return mbd.System([rod], [mbd.Revolute(ground.at(0.15, 0.0, 0.0), rod.at("left"), axis="y")], [spring], GRAVITY)


def loss(y: Tensor) -> Tensor:
    return (y * (1.0 + y))[..., :9].sum()


def test_its_parameters_are_those_of_the_system():
    system = hung()
    f = system()
    assert isinstance(f, torch.nn.Module)
    assert dict(f.named_parameters()).keys() == dict(system.named_parameters()).keys()
    assert all(x is system.get_parameter(name) for name, x in f.named_parameters())


@pytest.mark.thorough
def test_the_adjoint_of_torchdiffeq_is_its_plain_gradient_and_that_of_simulate():
    """By angles, the stiffness of a spring and the initial state."""
    system, result = hung(), []
    f = system()
    y0 = f.initial_state().detach().requires_grad_()
    inputs = [system.get_parameter(ANGLES), system.get_parameter(STIFFNESS), y0]
    for solve in (torchdiffeq.odeint, torchdiffeq.odeint_adjoint):
        y = solve(f, y0, TIMES, method="dopri5", **TIGHT)
        result.append(torch.autograd.grad(loss(y[1:, 0]), inputs))
    # Near to the constraints, which y0 may leave here, the adjoint of the equations stiffens: compared by size.
    for plain, adjoint in zip(*result, strict=True):
        assert_close(adjoint, plain, rtol=0, atol=1e-5 * float(plain.abs().max()))
    for options in ({"method": "dopri5", "steps": 2, "gradients": "forward", **TIGHT}, {"steps": 160}):
        motion = mbd.simulate(system, END, **options)
        q = motion.q[0, [len(motion.t) // 2, -1]]
        by = torch.autograd.grad((q * (1.0 + q)).sum(), inputs[:2])
        for x, expected in zip(by, result[0], strict=False):
            tolerance = 1e-5 if "method" in options else 1e-3  # generalized-alpha: its own discretization
            assert_close(x, expected, rtol=0, atol=tolerance * float(expected.abs().max()))


@pytest.mark.thorough
def test_one_backward_pass_after_another():
    """The structure stage is not repeated, and not used up; new numbers are taken, in whatever way they were set."""
    system = hung()
    f, angles = system(), system.get_parameter(ANGLES)
    slopes = []
    for _ in range(2):
        angles.grad = None
        loss(f(0.0, f.initial_state())[0]).backward()
        slopes.append(angles.grad)
    assert torch.equal(*slopes)
    first, before = f.dynamics, f(0.0, f.initial_state()).detach()
    assert f.dynamics is first
    for change in (lambda: angles.data.add_(0.1), lambda: setattr(angles, "data", angles.data + 0.1)):
        change()
        after = f(0.0, f.initial_state()).detach()
        assert f.dynamics is not first
        assert not torch.equal(after, before)
        first, before = f.dynamics, after


@pytest.mark.thorough
def test_functional_call_and_transforms():
    system = hung()
    f = system()
    y0, angles = f.initial_state().detach(), system.get_parameter(ANGLES).detach()

    def slope(x: Tensor) -> Tensor:
        return torch.func.functional_call(f, {ANGLES: x}, (0.0, y0 + 0.01))[0]

    step = 1e-4
    with torch.no_grad():
        expected = torch.stack(
            [(slope(angles + step * e) - slope(angles - step * e)) / (2.0 * step) for e in torch.eye(2).double()], 1
        )
    size = float(expected.abs().max())
    for transform in (torch.func.jacrev, torch.func.jacfwd):
        assert_close(transform(slope)(angles), expected, rtol=0, atol=1e-6 * size)
    assert torch.equal(f(0.0, y0), system()(0.0, y0))

    def end(x: Tensor) -> Tensor:
        def g(t: Tensor, y: Tensor) -> Tensor:
            return torch.func.functional_call(f, {ANGLES: x}, (t, y))

        return loss(torchdiffeq.odeint(g, y0, TIMES, method="rk4", options={"step_size": 1e-4})[-1])

    by = (float(end(angles + d)) - float(end(angles - d)) for d in step * torch.eye(2).double())
    assert_close(torch.func.grad(end)(angles), torch.tensor([x / (2.0 * step) for x in by]).double(), rtol=1e-5, atol=0)


@pytest.mark.thorough
def test_copies_pickles_and_loaded_numbers():
    system = hung()
    f = system()
    y0 = f.initial_state()
    dy = f(0.0, y0).detach()
    for again in (copy.deepcopy(f), pickle.loads(pickle.dumps(f))):
        assert torch.equal(again(0.0, y0).detach(), dy)
        with torch.no_grad():
            again.get_parameter(ANGLES).add_(0.1)
        assert not torch.equal(again(0.0, y0).detach(), dy)
        again.load_state_dict(f.state_dict())
        assert torch.equal(again(0.0, y0).detach(), dy)
    assert torch.equal(f(0.0, y0).detach(), dy)


@pytest.mark.thorough
def test_what_it_computes_in():
    """float64 on the CPU; one sentence for anything else."""
    system = pendulum()
    f = system()
    y0 = f.initial_state().detach()
    assert torch.equal(f.to(torch.float64)(0.0, y0), f.to("cpu")(0.0, y0))
    with refused("z"):
        f(0.0, y0.float())
    with refused("z"):
        f(0.0, y0.to("meta"))
    with refused("system", ANY, "torch.float32 on cpu", "torch.float64 on cpu"):
        torchdiffeq.odeint(copy.deepcopy(f).float(), y0, TIMES)
    with refused("system", ANY, "torch.float64 on meta", "torch.float64 on cpu"):
        copy.deepcopy(f).to("meta").initial_state()


@pytest.mark.thorough
def test_second_derivatives_are_refused_by_torch():
    system = hung()
    f, angles = system(), system.get_parameter(ANGLES)
    (slope,) = torch.autograd.grad(loss(f(0.0, f.initial_state())), angles, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        slope.sum().backward()
