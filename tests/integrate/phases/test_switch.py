"""Both sides of a switch: before it the numbers of the last step, after it those of the equations of motion."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd

G = 9.81


def pendulum() -> mbd.System:
    """A mass of 2 kg at 1 m below its hinge, started aside: the pull along the rod is known at every position and rate."""
    bob = mbd.RigidBody("bob", 2.0, (1e-9, 1e-9, 1e-9), position=(1.0, 0, 0))
    hinge = mbd.Revolute(mbd.Ground().at(), bob.at(-1.0, 0, 0), axis="y", name="hinge")
    return mbd.System([bob], [hinge], gravity=(0.0, 0.0, -G))


def simulated(phases: list[mbd.Phase] | None, method: str = "generalized_alpha") -> mbd.Trajectory:
    options = {"steps": 40, "phases": phases, "gradients": "none", "backend": "eager"}
    return mbd.simulate(pendulum(), 0.4, method, **options).require_ok()


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "hht_alpha"])
def test_before_a_switch_are_the_numbers_of_the_last_step(method):
    """Of a phase that ends with a step: those of the motion without the switch at this time."""
    plain = simulated(None, method)
    [switch] = simulated([mbd.Phase(until=0.2), mbd.Phase()], method).switches
    for name in ("q", "v", "a", "lam"):
        x, y = getattr(switch.before, name), getattr(plain, name)[:, 20]
        assert_close(x, y, rtol=0.0, atol=1e-9 * float(y.abs().max()))


@pytest.mark.thorough
def test_after_a_switch_are_the_numbers_of_the_equations_of_motion():
    """m r'' = m g + pull: the acceleration of the bob is that of its angle and rate, to rounding, at any time."""
    [switch] = simulated([mbd.Phase(until=0.2137), mbd.Phase()]).switches
    r, v, a = switch.after.q[0, :3], switch.after.v[0, :3], switch.after.a[0, :3]
    radial, gravity = r / r.norm(), torch.tensor([0.0, 0.0, -G], dtype=torch.float64)
    expected = gravity - (gravity @ radial) * radial - (v @ v) / r.norm() * radial
    assert_close(a, expected, rtol=0.0, atol=1e-6 * G)
    assert float((switch.before.a[0, :3] - expected).norm()) > 1e-6 * G  # of a step
