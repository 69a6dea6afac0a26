"""Singular positions are found, timed and named: four-bars that fold flat, and a crank that locks its slider."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import pendulum
from tests.validation.rigid_benchmarks import n_four_bar, n_four_bar_at
from torchmbd.integrators.signals import Given
from torchmbd.integrators.singular import explained


@pytest.fixture(scope="module")
def folding() -> mbd.Trajectory:
    return mbd.simulate(n_four_bar(), 0.8, method="dopri5", steps=80, rtol=1e-8, atol=1e-9).require_ok()


def test_a_flat_four_bar_is_singular_where_it_lies_flat(folding):
    """The uprights lie flat at 90 degrees: the time from the closed solution, to an output interval."""
    t = np.linspace(0.0, 0.8, 100001)
    flat = float(t[np.abs(n_four_bar_at(t) - np.pi / 2).argmin()])
    (found,) = folding.singular_positions()
    assert found.t == pytest.approx(flat, abs=0.6 * float(folding.t[1]))
    assert found.value < 2e-2
    joints = {row.partition(":")[0] for row in found.rows}
    assert joints & {f"{name}_{k}" for name, n in (("foot", 3), ("left", 2), ("right", 2)) for k in range(n)}
    assert f"singular position near t = {found.t:.6g} s (lane 0" in str(found)
    assert "depend on each other" in str(found)


def test_a_motion_that_failed_says_where(folding):
    gone = folding.t[:, None] > 0.755
    states = {name: torch.where(gone, torch.nan, getattr(folding, name)) for name in ("q", "v", "a", "lam")}
    status = ["failed: the motion is not finite from t = 0.76 s on"]
    failed = replace(folding, signals=Given(states), status=status)
    (status,) = explained(failed).status
    assert status.startswith("failed: the motion is not finite from t = 0.76 s on; singular position near t = 0.71")


def test_a_regular_motion_has_none():
    motion = mbd.simulate(pendulum(), 0.02, steps=40).require_ok()
    assert motion.singular_positions() == []


def test_a_slider_driven_through_its_dead_point_fails_with_a_word():
    """The slider of a slider-crank cannot be driven past the stretched position of the crank: the run ends there."""
    ground = mbd.Ground()
    crank = mbd.RigidBody("crank", 0.1, (1e-4, 1e-4, 1e-4), axes=_about_z(0.6))
    joint = crank.axes @ torch.tensor([0.2, 0.0, 0.0]).double()
    end = float(joint[0]) + (0.25 - float(joint[1]) ** 2) ** 0.5
    tilt = -float(torch.asin(joint[1] / 0.5))
    rod = mbd.RigidBody("rod", 0.1, (1e-4, 1e-4, 1e-4), position=joint, axes=_about_z(tilt))
    slider = mbd.RigidBody("slider", 0.1, (1e-4, 1e-4, 1e-4), position=(end, 0.0, 0.0))
    joints = [
        mbd.Revolute(ground.at(), crank.at(), name="main"),
        mbd.Revolute(crank.at(0.2, 0.0, 0.0), rod.at(), name="big_end"),
        mbd.Spherical(rod.at(0.5, 0.0, 0.0), slider.at(), name="small_end"),
        mbd.Prismatic(ground.at(end, 0.0, 0.0), slider.at(), axis="x", name="guide"),
        mbd.Drive(ground.at(end, 0.0, 0.0), slider.at(), axis="x", velocity=0.5, name="pusher"),
    ]
    system = mbd.System([crank, rod, slider], joints)
    reach = (0.7 - end) / 0.5
    for method in ("generalized_alpha", "rk4"):
        motion = mbd.simulate(system, 1.5 * reach, steps=60, method=method)
        assert motion.status[0].startswith("failed")
        near = float(motion.status[0].partition("near t = ")[2].partition(" s")[0])
        assert near == pytest.approx(reach, rel=0.15)


def _about_z(angle: float) -> torch.Tensor:
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
