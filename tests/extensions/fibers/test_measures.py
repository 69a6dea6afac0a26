"""Limits of steered fibers: the largest of all cells, and its smooth bound; refusals."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from tests.extensions.fibers.steered_arm import steered_arm
from tests.refused import refused


@pytest.fixture(scope="module")
def motion():
    """Two designs of a steered arm: one random, one straight."""
    angles = torch.randn(2, 6, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    angles[1] = 0.4
    return mbd.simulate(steered_arm(), 0.01, steps=4, designs={"arm.laminate.angles": angles})


@pytest.mark.parametrize("kind", [mbd.fibers.FiberCurvature, mbd.fibers.FiberDivergence])
def test_norms_bound_the_largest(motion, kind):
    exact = kind("arm")(motion)
    assert exact[0] > 1.0
    assert exact[1] < 1e-12
    values = 8 * 2
    for power in (10.0, 100.0):
        smooth = kind("arm", power)(motion)
        assert exact[0] <= smooth[0] <= values ** (1.0 / power) * exact[0]


@pytest.mark.thorough
def test_straight_fibers_have_gradients(motion):
    """Finite ones, where nothing turns."""
    straight = mbd.simulate(steered_arm(), 0.01, steps=4)
    for power in (None, 20.0):
        assert mbd.fibers.FiberCurvature("arm", power).value_and_gradient(straight)[1].isfinite().all()


@pytest.mark.thorough
def test_refused():
    straight = mbd.simulate(mbd.examples.arm(), 0.01, steps=4)
    with refused("body", "arm"):
        mbd.fibers.FiberCurvature("arm")(straight)
    with refused("power", 1.0):
        mbd.fibers.FiberDivergence("arm", power=1.0)
