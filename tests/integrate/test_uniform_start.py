"""Steps with a new matrix for every correction begin with a uniform motion, whatever the accelerations of before."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.integrate.test_stepper import arm
from tests.mechanisms import tensor
from torchmbd.integrate.generalized_alpha import GeneralizedAlpha
from torchmbd.integrate.prepared import prepare
from torchmbd.integrate.step import Model
from torchmbd.multibody.equations import equations

GROUND = mbd.Ground()


def test_positions_go_on_at_the_rates_of_the_start() -> None:
    """q1 = q0 o exp(h v0) and the multipliers of before, by any method of the family."""
    dynamics = mbd.simulate(arm(), 0.02, steps=4, gradients="none").dynamics
    x = prepare(dynamics).detached()[2]
    x = x._replace(vd=x.vd + 1e5, a=x.a - 3e4)
    (prescribed,) = dynamics.topology.schedule(tensor(0.01), dynamics.data)
    for radius in (0.0, 0.6, 1.0):
        w = GeneralizedAlpha(spectral_radius=radius).weights(0.01)
        step = Model.of(dynamics, w).step(x, prescribed)
        z = step.uniform()
        after = step.finish(z)
        assert_close(after.q, equations.advance(dynamics.topology, x.q, 0.01 * x.v), rtol=0, atol=1e-12)
        assert torch.equal(after.lam, x.lam)


def let_go() -> tuple[mbd.System, list[mbd.Phase]]:
    """A beam carries a load, is locked at its root, turns down, and lets the load go: its end accelerates by 5e5 m/s^2."""
    carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    section = mbd.sections.box(0.02, 0.006, carbon, mbd.deg([25, -40]), thickness=0.25e-3, cells=(4, 2, 1))
    wing = mbd.FlexibleBeam("wing", mbd.BeamLine.straight(0.6, elements=3), section, damping=2e-4)
    load = mbd.RigidBody("load", 0.05, (1e-5,) * 3, position=(0.6, 0.0, 0.0))
    root = mbd.Revolute(GROUND.at(), wing.at("start"), axis="z", name="root")
    hook = mbd.Fixed(wing.at("end"), load.at(), name="hook")
    spring = mbd.RotationalSpringDamper(GROUND.at(), wing.at("start"), axis="z", stiffness=1.5, damping=0.02)
    wind = mbd.Force(load.at(), (0.0, -0.6, 0.3), name="wind")
    system = mbd.System([wing, load], [root, hook], [spring, wind], gravity=(0.0, -9.81, 0.0), free=["load"])
    down = mbd.Event(mbd.Position("load", "y") + 0.12, "falling")
    phases = [
        mbd.Phase(until=0.03, lock=["root"]),
        mbd.Phase(until=down),
        mbd.Phase(lock=["root"], release=["hook"]),
    ]
    return system, phases


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["eager", "native"])
def test_a_beam_that_is_let_go_converges(backend: str) -> None:
    """Newton's method from the accelerations of before did not come back; the load that is let go flies freely."""
    system, phases = let_go()
    motion = mbd.simulate(system, 0.2, steps=100, phases=phases, gradients="none", backend=backend).require_ok()
    last = motion.switches[1]
    t = 0.2 - float(last.t[0])
    released = motion.at_moment(0, last.t[0], last.after)
    v = torch.stack([mbd.Velocity("load", axis)(released)[0, 0] for axis in "xyz"])
    flight = released.body("load").r[0, 0] + t * v + 0.5 * t * t * tensor(0.0, -9.81 - 0.6 / 0.05, 0.3 / 0.05)
    assert_close(motion.body("load").r[0, -1], flight, rtol=0, atol=2e-5)
    nodes = motion.body("wing").nodes[0, -1]
    length = nodes.diff(dim=0).norm(dim=1).sum()
    assert_close(length, tensor(0.6)[0], rtol=1e-3, atol=0.0)
