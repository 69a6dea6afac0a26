"""Matrices of tangents from few directions are those of all unit vectors, for every kind of coupling."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.multibody.equilibrium.test_ground_observer import rotor
from torchmbd.multibody.equations.coupling import Coupling
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import SteadyRotation


def servo() -> mbd.System:
    """A controller couples bodies that no joint or force does."""
    bodies = [
        mbd.RigidBody(name, 1.0, (0.01, 0.02, 0.03), position=(0.3 * i, 0.1, 0.0)) for i, name in enumerate("abcd")
    ]
    ground = mbd.Ground()
    hinges = [mbd.Revolute(ground.at(0.3 * i, 0, 0), b.at(), axis="z", name=f"hinge{i}") for i, b in enumerate(bodies)]
    inputs = [mbd.signals.JointAngle(hinges[0]), mbd.signals.JointRate(hinges[1])]
    torch.manual_seed(3)
    control = mbd.Controller(torch.nn.Linear(2, 1).double(), inputs, [mbd.signals.JointTorque(hinges[3])], name="servo")
    spring = mbd.SpringDamper(bodies[1].at(0.1, 0, 0), bodies[2].at(0.0, 0.1, 0), stiffness=30.0, damping=0.4)
    return mbd.System(bodies, hinges, [control, spring])


SYSTEMS = {
    "pendulum": pendulum,
    "rotor": lambda: rotor(1.5, {0.5: 0.28, 1.0: 0.35}, (0.0, 1.5), (1e6, 0.8e6), 6),
    "servo": servo,
}


@pytest.mark.parametrize("rotates", [False, True])
@pytest.mark.parametrize("name", list(SYSTEMS))
def test_few_directions_suffice(name, rotates, monkeypatch):
    dynamics = SYSTEMS[name]().dynamics().values()
    T = dynamics.topology
    q = dynamics.start[0][:, 0, 0]
    spin = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)[:, None, None]
    observer = SteadyRotation(spin, torch.zeros(3, dtype=torch.float64)) if rotates else None
    few = Linearization.of(dynamics, q, q.new_zeros(()), None, observer)
    every = torch.arange(T.n_v).expand(T.n_v + T.rows, T.n_v)
    monkeypatch.setitem(vars(T), "coupling", Coupling(torch.eye(T.n_v, dtype=torch.float64), every))
    dense = Linearization.of(dynamics, q, q.new_zeros(()), None, observer)
    for x in ("K", "C", "M", "Phi_q"):
        got, expected = getattr(few, x), getattr(dense, x)
        assert_close(got, expected, rtol=0.0, atol=1e-12 * float(expected.abs().max().clamp_min(1e-300)))


def test_a_chain_takes_as_many_directions_as_three_bodies():
    short, long = (rotor(1.5, {}, (0.0, 1.5), (1e6, 0.8e6), n).topology.coupling.directions.shape[1] for n in (6, 24))
    assert short == long == 18
