"""Joints stay closed over a run, and Euler parameters keep their length: both routes, on the slider-crank."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from torchmbd.integrate import Trajectory
from torchmbd.multibody.equations import equations

pytestmark = pytest.mark.usefixtures("compiled")


def violations(motion: Trajectory) -> tuple[float, float]:
    """Largest Phi [m] and Phi' [m/s] of the first lane at all output times."""
    T, data = motion.dynamics.topology, motion.dynamics.values().data
    worst = [0.0, 0.0]
    for t, q, v in zip(motion.t, motion.q[0][..., None, None], motion.v[0][..., None, None], strict=True):
        at = equations.placement(T, data, q, T.prescribed(t))
        jets = equations.constraint_jets(T, at, data, v, torch.zeros_like(v), t)
        worst = [max(w, float(x.abs().max())) for w, x in zip(worst, jets.parts, strict=False)]
    return worst[0], worst[1]


ROUTES = {
    "generalized_alpha": {"duration": 0.01, "steps": 100},
    "rk4": {"duration": 0.002, "steps": 50},
    "dopri5": {"duration": 0.002, "steps": 4, "rtol": 1e-5, "atol": 1e-7},
}


@pytest.mark.thorough
@pytest.mark.parametrize("method", ROUTES)
def test_joints_stay_closed(method, slider_crank):
    motion = mbd.simulate(slider_crank, method=method, **ROUTES[method]).require_ok()
    position, velocity = violations(motion)
    assert position < 1e-8
    # Index 3 fulfills the positions exactly and the velocities to the order of the step; index 1 both.
    assert velocity < (2e-3 if method == "generalized_alpha" else 1e-5)
    for name in ("crank", "rod", "slider"):
        p = motion.body(name).p
        assert float((p.norm(dim=-1) - 1.0).abs().max()) < (1e-13 if method == "generalized_alpha" else 1e-7)


@pytest.mark.thorough
def test_stabilization_takes_a_violation_back():
    """Started with an open joint, the index-1 equations close it: without 2 alpha Phi' + alpha^2 Phi it stays open."""
    ground, body = mbd.Ground(), mbd.RigidBody("disk", 1.0, (1e-2, 2e-2, 3e-2))
    system = mbd.System([body], [mbd.Revolute(ground.at(), body.at(0.1, 0.0, 0.0), axis="z")], stabilization=5e-3)
    dynamics = system.dynamics()
    z = dynamics.initial_state()
    z[:, 1] += 1e-3
    h = 1e-3
    for _ in range(50):  # ten time constants, by Heun's method
        k1 = dynamics(0.0, z)
        z = z + 0.5 * h * (k1 + dynamics(0.0, z + h * k1))
    T = system.topology
    at = equations.placement(
        T, dynamics.data, z[:, : T.n_q].T[:, None], T.prescribed(torch.zeros((), dtype=torch.float64))
    )
    assert float(equations.constraints(T, at).abs().max()) < 1e-5
