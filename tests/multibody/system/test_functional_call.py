"""Other tensors in the place of a system's own: they are used, or refused by name, in whatever way they come in."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, grad, jacfwd, jacrev
from torch.nn.utils import parametrize
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.refused import refused

ANGLES = "arm.laminate.angles"
NEW = tensor(1.3, -0.3)


class Shifted(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x - x.detach() + NEW


class Motion(nn.Module):
    """The end of a motion, as a module that holds a system."""

    def __init__(self, system: mbd.System):
        super().__init__()
        self.system = system

    def forward(self) -> Tensor:
        return mbd.simulate(self.system, 0.02, steps=4).q[0, -1]


def changed() -> mbd.System:
    """The arm whose own angles are NEW."""
    system = mbd.examples.arm()
    with torch.no_grad():
        system.get_parameter(ANGLES).copy_(NEW)
    return system


def state(system: mbd.System) -> Tensor:
    """The start with a deformed arm."""
    z = system().initial_state().detach().clone()
    z[:, 7:9] += 1e-3
    return z


def assigned(system: mbd.System) -> mbd.System:
    system.load_state_dict(changed().state_dict(), assign=True)
    return system


def parametrized(system: mbd.System) -> mbd.System:
    parametrize.register_parametrization(system.get_submodule("arm.laminate"), "angles", Shifted())
    return system


WAYS = {
    "tensor": lambda s: functional_call(s, {ANGLES: NEW.clone()}, ()),
    "parameter": lambda s: functional_call(s, {ANGLES: nn.Parameter(NEW.clone())}, ()),
    "copy first": lambda s: functional_call(copy.deepcopy(s), {ANGLES: NEW.clone()}, ()),
    "copy after": lambda s: copy.deepcopy(functional_call(s, {ANGLES: NEW.clone()}, ())),
    "pickle": lambda s: pickle.loads(pickle.dumps(functional_call(s, {ANGLES: NEW.clone()}, ()))),
    "assigned": lambda s: assigned(s)(),
    "assigned after": lambda s: (s(), assigned(s))[0],
    "parametrized": lambda s: parametrized(s)(),
    "parametrized after": lambda s: (s(), parametrized(s))[0],
}


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_an_equation_of_motion_keeps_the_numbers_that_its_system_was_called_with(way):
    system = mbd.examples.arm()
    z = state(system)
    assert_close(WAYS[way](system)(0.0, z), changed()()(0.0, z), rtol=1e-12, atol=0)
    if way in ("tensor", "parameter"):
        assert torch.equal(system()(0.0, z), mbd.examples.arm()()(0.0, z))


@pytest.mark.thorough
def test_its_own_parameters_can_be_replaced_again():
    system = mbd.examples.arm()
    z = state(system)
    f = functional_call(system, {ANGLES: NEW + 1.0}, ())
    assert torch.equal(functional_call(f, {ANGLES: NEW.clone()}, (0.0, z)), changed()()(0.0, z))


@pytest.mark.thorough
def test_constants_are_taken_or_refused():
    """Gravity; constants that are differentiated have no gradient."""
    system = mbd.examples.arm()
    z, g = state(system), tensor(1.0, 2.0, 3.0)
    other = mbd.System(system.bodies, system.joints, system.forces, gravity=g)
    assert torch.equal(functional_call(system, {"gravity": g}, ())(0.0, z), other()(0.0, z))
    for transform in (grad, jacfwd):
        with refused("gravity"):
            transform(lambda x: functional_call(system, {"gravity": x}, ())(0.0, z).sum())(g)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["position", "velocity", "angular_velocity", "modal"])
def test_the_start_of_a_body_is_taken_whenever_it_is_set(name):
    """In place, by a new tensor, by functional_call and by load_state_dict: as for a system that is made with it."""
    system = mbd.examples.arm()
    own = getattr(system.arm, name)
    new = own + 1e-4 * torch.arange(1, 1 + len(own), dtype=torch.float64)
    before = Motion(system)()
    by_call = functional_call(Motion(system), {f"system.arm.{name}": new}, ())
    assert torch.equal(Motion(system)(), before)  # nothing is left behind
    loaded = mbd.examples.arm()
    loaded.load_state_dict(system.state_dict() | {f"arm.{name}": new})
    expected = Motion(loaded)()
    assert not torch.equal(expected, before)
    with torch.no_grad():
        own.copy_(new)
    for result in (by_call, Motion(system)()):
        assert_close(result, expected, rtol=1e-12, atol=1e-15)


def swinging() -> mbd.System:
    """A bob at a spherical joint: its mass, start and the point where it hangs are variables."""
    bob = mbd.RigidBody(
        "bob",
        mbd.variable(1.0),
        (0.01, 0.02, 0.01),
        position=nn.Parameter(tensor(0.02, -1.0, 0.0)),
        angular_velocity=nn.Parameter(tensor(0.0, 0.0, 1.0)),
    )
    hook = bob.at(0.0, mbd.variable(1.0), 0.0)
    return mbd.System([bob], [mbd.Spherical(mbd.Ground().at(), hook, name="hook")], gravity=(0.0, -9.81, 0.0))


def held_twice() -> mbd.System:
    """Redundant rows."""
    ground = mbd.Ground()
    bob = mbd.RigidBody(
        "bob",
        1.0,
        (0.01, 0.02, 0.01),
        position=(0.0, -1.0, 0.0),
        angular_velocity=(0.0, 0.0, 1.0),
        center=nn.Parameter(tensor(0.1, 0.2, 0.3)),
    )
    frames = [(ground.at(0.0, 0.0, z), bob.at(0.0, 1.0, z)) for z in (0.0, 0.1)]
    hinges = [mbd.Revolute(*pair, axis="z", name=f"hinge_{i}") for i, pair in enumerate(frames)]
    return mbd.System([bob], hinges, gravity=(0.0, -9.81, 0.0))


def answer(system: mbd.System, name: str, x: Tensor) -> Tensor:
    """The start and its rate of change, by a system that has not moved before."""
    f = functional_call(system, {name: x}, ())
    z = f.initial_state()
    return torch.cat([z, f(0.0, z)], -1).flatten()


TRANSFORMS = {
    "jacrev": lambda f, x: jacrev(f)(x),
    "jacfwd": lambda f, x: jacfwd(f)(x),
    "vmap": lambda f, x: torch.vmap(f)(torch.stack([1.001 * x, x]))[1],
    "vmap(jacrev)": lambda f, x: torch.vmap(jacrev(f))(torch.stack([1.001 * x, x]))[1],
    "vmap(jacfwd)": lambda f, x: torch.vmap(jacfwd(f))(torch.stack([1.001 * x, x]))[1],
    "jacrev(vmap)": lambda f, x: jacrev(lambda y: torch.vmap(f)(torch.stack([1.001 * y, y]))[1])(x),
}


@pytest.mark.thorough
@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("make", [swinging, held_twice, mbd.examples.arm])
def test_transforms_of_a_system_that_has_not_moved(make, transform):
    """Values and differences by each parameter; the system is as before."""
    h, fresh = 1e-6, make()
    own = answer(fresh, *next(iter(fresh.named_parameters()))).detach()
    for name, parameter in make().named_parameters():
        system, x = make(), 1.01 * parameter.detach()
        result = TRANSFORMS[transform](lambda y, s=system, n=name: answer(s, n, y), x)
        if transform == "vmap":
            expected = answer(make(), name, x)
        else:
            steps = h * torch.eye(x.numel(), dtype=x.dtype).reshape(-1, *x.shape)
            slopes = [(answer(make(), name, x + d) - answer(make(), name, x - d)) / (2.0 * h) for d in steps]
            expected = torch.stack(slopes, -1).reshape(result.shape)
        assert_close(result, expected, rtol=0, atol=1e-5 * float(expected.detach().abs().max()))
        assert torch.equal(answer(system, *next(iter(system.named_parameters()))), own)


@pytest.mark.thorough
def test_transforms_by_the_state_keep_gradients_of_the_parameters():
    """On a system that has not moved: the structure stage runs outside of the transform."""
    z = state(mbd.examples.arm())
    states, slopes = torch.stack([z, 1.001 * z]), []
    for run in (torch.vmap, lambda f: lambda xs: torch.stack([f(x) for x in xs])):
        system = mbd.examples.arm()
        f = system()
        run(lambda y, f=f: f(0.0, y))(states).square().sum().backward()
        slopes.append(system.get_parameter(ANGLES).grad)
        assert jacrev(lambda y, f=f: f(0.0, y))(z).shape == (1, 30, 1, 30)
    assert_close(*slopes, rtol=1e-9, atol=0)
