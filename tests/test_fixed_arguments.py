"""An argument that is set after construction is used or refused by its name, for every kind of object that a user makes."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import torchmbd as mbd
from tests.refused import refused
from torchmbd.errors import InputError, argument_names

ENERGY = mbd.Integral(mbd.StrainEnergy("arm"))


def problem_of(system: mbd.System) -> mbd.Problem:
    return mbd.Problem(system, 0.02, ENERGY, steps=8, bounds=mbd.deg([-90, 90]), variables=["arm.laminate.angles"])


def objects() -> dict[str, Any]:
    """One of each kind, by its name."""
    system = mbd.examples.arm()
    arm, tool = system.bodies
    ground, problem = mbd.Ground(), problem_of(system)
    spring = mbd.SpringDamper(ground.at(), tool.at(), stiffness=10.0, name="spring")
    section = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)
    return {
        "system": system,
        "flexible body": arm,
        "rigid body": tool,
        "flexible beam": mbd.FlexibleBeam("cable", mbd.BeamLine.straight(1.0, elements=2), section),
        "laminate": arm.laminate,
        "joint": system.joints[0],
        "spring": spring,
        "force": mbd.Force(tool.at(), (0.0, 0.0, 1.0), name="force"),
        "problem": problem,
        "robust problem": mbd.optimization.RobustProblem(problem, 0.04),
        "simulation": mbd.Simulation(system, 0.02, steps=8),
    }


@pytest.mark.parametrize("kind", objects())
def test_an_argument_is_used_or_refused(kind):
    """An attribute of this name that the object has is a tensor or a module, which torch checks, or a number that is read."""
    made = objects()[kind]
    for name in argument_names(type(made)):
        read = any(name in vars(made).get(members, ()) for members in ("_parameters", "_buffers", "_modules"))
        if read or name in made.free_arguments or isinstance(getattr(type(made), name, None), property):
            continue
        with pytest.raises(InputError, match=rf"{name} = .*must be an argument of {type(made).__name__}\("):
            setattr(made, name, 1.5)


def test_the_error_names_object_and_remedy():
    with refused("arm.modes", 10, "must be an argument of FlexibleBody(...)", "FlexibleBody(..., modes=...)"):
        mbd.examples.arm().bodies[0].modes = 10
    simulation = mbd.Simulation(mbd.examples.arm(), 0.02, steps=8)
    with refused("steps", 16, "must be an argument of Simulation(...)", "simulation.with_arguments(steps=...)"):
        simulation.steps = 16


def test_collections_of_a_system_cannot_grow():
    system = mbd.examples.arm()
    assert all(isinstance(x, tuple) for x in (system.bodies, system.beams, system.joints, system.forces))


def test_what_is_read_can_be_set():
    system = mbd.examples.arm()
    before = mbd.simulate(system, 0.02, steps=8).q
    system.bodies[1].mass = 2.0 * system.bodies[1].mass
    system.stabilization = 1e-2
    assert not torch.equal(mbd.simulate(system, 0.02, steps=8).q, before)


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_have_fixed_arguments_too(way):
    with pytest.raises(InputError):
        way(mbd.examples.arm()).forces = []


def test_a_class_of_a_user_can_set_its_own():
    """Before and after its base is constructed; an attribute that is no argument stays its own."""

    class Counted(mbd.RigidBody):
        def __init__(self, name: str, count: int):
            self.count = count
            super().__init__(name, 1.0, (0.01, 0.01, 0.01))
            self.count = count + 1
            self.seen = 0

    body = Counted("body", 3)
    body.seen += 1
    assert (body.count, body.seen) == (4, 1)
    with pytest.raises(InputError):
        body.count = 7


def test_parameters_of_torch_can_be_set():
    system = mbd.examples.arm()
    angles = system.bodies[0].laminate.angles
    system.bodies[0].laminate.angles = nn.Parameter(angles.detach() + 0.1)
    moved = dict(system.named_parameters())["arm.laminate.angles"]
    np.testing.assert_allclose(moved.detach(), angles.detach() + 0.1)
