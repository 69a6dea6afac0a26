"""The contract of every integrator: it converges to the motion, and a lane that fails is named, alone.

The mechanism is a spatial double pendulum with a flexible part, two designs side by side.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from torchmbd.integrators import METHODS, Trajectory
from torchmbd.integrators.attempts import run
from torchmbd.integrators.registry import integrator_of

DURATION = 0.02


@dataclass(frozen=True)
class Accuracy:
    """How a method is asked to run, and the error that its order allows: largest of q [m, -] and of v [m/s, rad/s]."""

    q: float
    v: float
    steps: int = 40
    options: dict[str, Any] = field(default_factory=dict)


def adaptive(rtol: float, q: float, v: float) -> Accuracy:
    return Accuracy(q, v, steps=1, options={"rtol": rtol, "atol": 1e-2 * rtol})


ACCURACY = {
    "generalized_alpha": Accuracy(1e-6, 1e-4, steps=50),
    "euler": Accuracy(2e-4, 2e-2),
    "midpoint": Accuracy(2e-6, 2e-4),
    "heun2": Accuracy(2e-6, 2e-4),
    "heun3": Accuracy(1e-8, 5e-6),
    "rk4": Accuracy(1e-9, 5e-7),
    "explicit_adams": Accuracy(1e-8, 2e-6),
    "implicit_adams": Accuracy(1e-10, 1e-7),
    "fixed_adams": Accuracy(1e-10, 1e-7),
    "adaptive_heun": adaptive(1e-5, 2e-6, 2e-4),
    "fehlberg2": adaptive(1e-6, 2e-5, 1e-3),
    "bosh3": adaptive(1e-7, 1e-6, 1e-4),
    "dopri5": adaptive(1e-7, 1e-8, 1e-6),
    "dopri8": adaptive(1e-8, 1e-9, 1e-6),
}
every_method = pytest.mark.parametrize("method", METHODS)


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return pendulum()


@pytest.fixture(scope="module")
def designs() -> dict[str, torch.Tensor]:
    return {"rod.laminate.angles": mbd.deg([[20.0, -50.0], [10.0, 70.0]])}


@pytest.fixture(scope="module")
def reference(system, designs) -> Trajectory:
    return mbd.simulate(system, DURATION, "dopri8", steps=1, designs=designs, rtol=1e-11, atol=1e-12).require_ok()


def test_every_method_is_here():
    assert set(ACCURACY) == set(METHODS)


@every_method
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_method_ends_where_the_motion_ends(method, system, designs, reference):
    asked = ACCURACY[method]
    motion = mbd.simulate(system, DURATION, method, steps=asked.steps, designs=designs, **asked.options)
    assert motion.status == ["ok", "ok"]
    assert motion.t.tolist() == pytest.approx([DURATION * i / asked.steps for i in range(asked.steps + 1)])
    assert_close(motion.q[:, 0], reference.q[:, 0], rtol=0, atol=1e-12)
    assert_close(motion.q[:, -1], reference.q[:, -1], rtol=0, atol=asked.q)
    assert_close(motion.v[:, -1], reference.v[:, -1], rtol=0, atol=asked.v)
    # Accelerations of the fastest modes (some 1000 rad/s) are that much less exact; reactions stand between both.
    assert_close(motion.a[:, -1], reference.a[:, -1], rtol=0, atol=1000 * asked.v)
    assert_close(motion.lam[:, -1], reference.lam[:, -1], rtol=0, atol=10 * asked.v)


@every_method
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_a_lane_that_fails_is_named_and_leaves_the_others_alone(method, system, designs):
    """A nan in one design: the other must come out as if it ran alone."""
    asked = ACCURACY[method]
    steps = min(asked.steps, 10)
    # Order and size of the implicit methods' functional iteration depend on all lanes: compare within its tolerance.
    tolerance = 1e-8 if method in ("implicit_adams", "fixed_adams") else 1e-13
    integrator = integrator_of(method, asked.options)
    with torch.no_grad():
        sick = system.dynamics(designs)
        sick.data["Kr"] = sick.data["Kr"].clone()
        sick.data["Kr"][..., 1] = torch.nan
        history, _, status = run(integrator, sick, DURATION, steps, precise=False)
        alone, _, healthy = run(integrator, system.dynamics(designs).some([0]), DURATION, steps, precise=False)
    assert healthy == ["ok"]
    assert status[0] == "ok"
    assert status[1].startswith("failed: ")
    assert_close(history.q[..., :1], alone.q, rtol=0, atol=tolerance)
    assert_close(history.v[..., :1], alone.v, rtol=0, atol=tolerance)


@pytest.mark.parametrize("method", ["rk4", "heun3", "generalized_alpha"])
def test_a_motion_that_diverges_is_a_status_not_an_exception(method, system):
    """An explicit step beyond the stability limit of one lane overflows; the stable lane of the batch must not end with it."""
    stiff = {"rod.laminate.thickness": torch.tensor([[1.5e-3, 1.5e-3], [0.02, 0.02]], dtype=torch.float64)}
    motion = mbd.simulate(system, 0.5, method, steps=100, designs=stiff)
    assert motion.status[0] == "ok"
    assert torch.isfinite(motion.q[0]).all()
    if method == "generalized_alpha":  # unconditionally stable
        assert motion.ok
        return
    assert "not finite from t = " in motion.status[1]
    assert not motion.ok
    with pytest.raises(mbd.SimulationFailure, match="lane 1: failed: the motion is not finite"):
        motion.require_ok()
