"""The picture of fiber paths: layers, directions, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.extensions.fibers.steered_arm import steered_arm
from tests.refused import refused


@pytest.mark.thorough
def test_lines_follow_the_fibers():
    """Straight fibers at 30 degrees are straight lines at 30 degrees."""
    body = steered_arm().body("arm")
    with torch.no_grad():
        body.laminate.angles[:] = torch.tensor([math.radians(30.0), math.radians(-60.0)], dtype=torch.float64)
    figure = mbd.viz.fiber_paths(body)
    for axes, angle in zip(figure.axes, (30.0, -60.0), strict=False):
        pieces = np.concatenate([x for lines in axes.collections for x in lines.get_segments()]).reshape(-1, 2, 2)
        arm = pieces[:, 1] - pieces[:, 0]
        arm = arm[np.hypot(*arm.T) > 1e-6]
        assert np.allclose(
            np.cross(arm, [math.cos(math.radians(angle)), math.sin(math.radians(angle))]), 0.0, atol=1e-6
        )


def test_refused():
    with refused("body"):
        mbd.viz.fiber_paths(mbd.examples.arm().body("arm"))
