"""Rigid benchmarks against their closed solutions, with the drift of energy and constraints; see rigid_benchmarks.py.

The benchmark of the library (A01, A02, A04) is 10 s of motion; the marked tests run it in full, the others the beginning.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.validation.rigid_benchmarks import (
    bricard,
    bricard_at,
    heavy_top,
    heavy_top_at,
    n_four_bar,
    n_four_bar_at,
    simple_pendulum,
    simple_pendulum_at,
)
from torchmbd.multibody.equations import equations

TIGHT = {"rtol": 1e-10, "atol": 1e-11}


def run(system: mbd.System, duration: float, steps: int, method: str = "dopri8", **options) -> mbd.Trajectory:
    return mbd.simulate(system, duration, method=method, steps=steps, **(TIGHT | options)).require_ok()


def energy(motion: mbd.Trajectory) -> np.ndarray:
    """Kinetic and total energy [2, times] of rigid bodies."""
    kinetic, potential = torch.zeros_like(motion.t), torch.zeros_like(motion.t)
    for body in motion.system.bodies:
        view = motion.body(body.name)
        at = view.at(body.center.tolist())
        J = body.second_moment.trace() * torch.eye(3, dtype=torch.float64) - body.second_moment
        spin = torch.einsum("ti,ij,tj->t", view.omega[0], J, view.omega[0])
        kinetic += 0.5 * body.mass * at.velocity[0].square().sum(-1) + 0.5 * spin
        potential -= body.mass * at.position[0] @ motion.system.gravity
    return torch.stack([kinetic, kinetic + potential]).numpy()


def violation(motion: mbd.Trajectory) -> float:
    """Largest violation of a joint over time [m] or [-]."""
    T, data = motion.dynamics.topology, motion.dynamics.data
    zero = torch.zeros((), dtype=torch.float64)
    at = equations.placement(T, data, motion.q[0].T[:, None], T.prescribed(zero))
    return float(equations.constraints(T, at).abs().max())


def check(motion: mbd.Trajectory, found: torch.Tensor, wanted: np.ndarray, error: float) -> None:
    assert np.abs(found.numpy() - wanted).max() < error
    kinetic, total = energy(motion)
    assert np.abs(total - total[0]).max() < error * kinetic.max()
    assert violation(motion) < error


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [2.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_simple_pendulum(duration):
    """A01; the library asks for 1e-5 J of drift in 10 s at its high precision."""
    motion = run(simple_pendulum(), duration, 20)
    result = motion.body("bob").at((-1.0, 0.0, 0.0)).position[0, :, :2]
    check(motion, result, simple_pendulum_at(motion.t.numpy()), 1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [1.1, pytest.param(10.0, marks=pytest.mark.slow)])
def test_n_four_bar_through_its_singular_positions(duration):
    """A02: flat on the ground at t = 0.71 s the mechanism has three freedoms; it goes on as before."""
    motion = run(n_four_bar(), duration, 22)
    th = n_four_bar_at(motion.t.numpy())
    assert th[-1] > np.pi / 2 + 0.3
    for k in range(3):
        result = motion.body(f"upright_{k}").at((0.0, 0.5, 0.0)).position[0, :, :2]
        expected = np.stack([k + np.sin(th), np.cos(th)], -1)
        assert np.abs(result.numpy() - expected).max() < 1e-6
    kinetic, total = energy(motion)
    assert np.abs(total - total[0]).max() < 1e-6 * kinetic.max()


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [1.1, pytest.param(10.0, marks=pytest.mark.slow)])
def test_n_four_bar_with_the_structural_integrator(duration):
    """A02 with equal steps, some of them next to singular positions: second order, no growth of the energy."""
    errors, drifts = [], []
    for steps in (round(100 * duration), round(200 * duration)):
        motion = mbd.simulate(n_four_bar(), duration, steps=steps, refresh=0).require_ok()
        th = n_four_bar_at(motion.t.numpy())
        result = motion.body("upright_2").at((0.0, 0.5, 0.0)).position[0, :, :2].numpy()
        errors.append(np.abs(result - np.stack([2.0 + np.sin(th), np.cos(th)], -1)).max())
        total = energy(motion)[1]
        drifts.append(np.abs(total - total[0]).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert np.log2(drifts[0] / drifts[1]) == pytest.approx(2.0, abs=0.1)
    assert errors[1] < 6e-4 * max(1.0, duration)
    assert drifts[1] < 0.03


def test_bricard_has_30_rows_of_rank_29():
    result = bricard().describe()
    assert (result.rows, result.rank, result.freedoms, len(result.redundant)) == (30, 29, 1, 1)
    assert result.redundant[0].startswith("hinge_")


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [0.8, pytest.param(10.0, marks=pytest.mark.slow)])
def test_bricard(duration):
    """A04: the closed chain of six hinges moves, by the one freedom that Gruebler's count denies it."""
    motion = run(bricard(), duration, 16, rtol=1e-9, atol=1e-10)
    expected = bricard_at(motion.t.numpy())
    result = torch.stack([motion.body(f"rod_{k}").at((0.0, 0.5, 0.0)).position[0] for k in range(5)], 1)
    assert np.abs(expected - expected[0]).max() > 0.3
    check(motion, result, expected, 1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_heavy_top(duration):
    motion = run(heavy_top(), duration, 20)
    result = motion.body("top").at((0.0, 1.0, 0.0)).position[0, :, 2]
    expected = heavy_top_at(motion.t.numpy())
    assert np.abs(expected).max() > 0.05
    check(motion, result, expected, 1e-6)


@pytest.mark.thorough
def test_heavy_top_with_the_structural_integrator():
    """Second order: a quarter of the error with half the step."""
    errors = []
    for steps in (500, 1000):
        motion = mbd.simulate(heavy_top(), 0.2, steps=steps, spectral_radius=0.9, iterations=(5, 5)).require_ok()
        result = motion.body("top").at((0.0, 1.0, 0.0)).position[0, :, 2]
        errors.append(np.abs(result.numpy() - heavy_top_at(motion.t.numpy())).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
