"""Steps of other sizes: what a lane has depends neither on the other lanes nor on the estimate from which it is iterated."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, box, tensor
from torchmbd.integrate import variable_step
from torchmbd.integrate.backend import with_backend
from torchmbd.integrate.generalized_alpha import GeneralizedAlpha
from torchmbd.integrate.lanes import lanes_of, pick_lanes, pick_states
from torchmbd.integrate.phases.switch import jump
from torchmbd.multibody.equations.times_as_lanes import at_time
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State

GROUND = mbd.Ground()
TIMES = tensor(0.013, 0.041, 0.077)[None]
SIZES = tensor(0.002, 0.0007, 0.001)[None]


def driven() -> mbd.System:
    """A driven arm with a bob, a force of time and one of position: all that depends on the time of a lane."""
    arm, bob = box("arm", position=(0.3, 0.0, 0.0)), box("bob", position=(0.6, 0.0, -0.2))
    return mbd.System(
        bodies=[arm, bob],
        joints=[
            mbd.Revolute(GROUND.at(), arm.at(-0.3, 0.0, 0.0), axis="z", name="shaft"),
            mbd.Drive(GROUND, arm, axis="z", angle=lambda t: 0.7 * torch.sin(9.0 * t), name="motor"),
            mbd.Universal(arm.at(0.3, 0.0, 0.0), bob.at(0.0, 0.0, 0.2), axes="yx", name="hook"),
        ],
        forces=[
            mbd.Force(bob.at(), lambda t: torch.stack([20.0 * t, torch.sin(40.0 * t), 0.3 + 0.0 * t])),
            mbd.SpringDamper(GROUND.at(0.3, 0.0, 0.2), bob.at(), stiffness=30.0, damping=0.2, rest=0.1),
        ],
        gravity=GRAVITY,
    )


def states() -> tuple[Dynamics, State]:
    """The states of a motion at three times as those of three lanes."""
    motion = mbd.simulate(driven(), 0.1, steps=100, gradients="none").require_ok()
    at = (TIMES[0] * 1000).round().long()
    q, v = (x[0, at].T[:, None] for x in (motion.q, motion.v))
    dynamics = motion.dynamics
    (v,) = at_time(jump, dynamics, TIMES, q, v)
    a, lam = at_time(Dynamics.accelerations, dynamics, TIMES, q, v)
    return dynamics, State(q, v, a, a, lam)


@pytest.mark.thorough
def test_lanes_at_their_own_times_have_what_each_has_alone():
    dynamics, x = states()
    step = GeneralizedAlpha().step_of_size
    with torch.no_grad():
        together = step(dynamics, x, SIZES, TIMES + SIZES)
        for lane in range(3):
            h, t = (pick_lanes(y, [lane]) for y in (SIZES, TIMES))
            alone = step(lanes_of(dynamics, [0]), pick_states(x, [lane]), h, t + h)
            for result, expected in zip(pick_states(together, [lane]), alone, strict=True):
                assert_close(result, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.thorough
def test_compiled_code_makes_the_steps_of_operators_of_torch(native, monkeypatch):
    """Each lane with its own size and time; from far accelerations, too."""
    dynamics, x = states()
    step, compiled, made = GeneralizedAlpha().step_of_size, with_backend(dynamics, "native"), []
    with torch.no_grad():
        expected = step(dynamics, x, SIZES, TIMES + SIZES)
        far = step(dynamics, x._replace(vd=30.0 * x.vd), SIZES, TIMES + SIZES)
        monkeypatch.setattr(variable_step, "_from", lambda *_: made.append("by torch"))
        for vd, states_of_torch in ((x.vd, expected), (30.0 * x.vd, far)):
            result = step(compiled, x._replace(vd=vd), SIZES, TIMES + SIZES)
            for y, z in zip(result, states_of_torch, strict=True):
                assert_close(y, z, rtol=1e-9, atol=1e-8)
    assert not made


@pytest.mark.thorough
def test_a_step_does_not_depend_on_its_estimate_and_is_nan_where_it_has_no_solution():
    dynamics, x = states()
    step = GeneralizedAlpha().step_of_size
    with torch.no_grad():
        expected = step(dynamics, x, SIZES, TIMES + SIZES)
        far = x._replace(vd=x.vd + 1e7 * torch.sin(torch.arange(x.vd.numel(), dtype=torch.float64)).reshape(x.vd.shape))
        result = step(dynamics, x, SIZES, TIMES + SIZES, far)
        for y, z in zip(result, expected, strict=True):
            assert_close(y, z, rtol=1e-8, atol=1e-7)
        h = SIZES * tensor(1.0, torch.nan, 1.0)
        broken = step(dynamics, x, h, TIMES + SIZES)
    assert torch.isfinite(broken.vd).flatten(0, 1).all(0).tolist() == [True, False, True]
    assert_close(broken.q[..., [0, 2]], expected.q[..., [0, 2]], rtol=0, atol=0)
