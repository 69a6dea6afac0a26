"""MuJoCo's slider-crank with a soft rod against the figures of Exudyn, and of MuJoCo itself (MUJOCO_MODELS)."""

from __future__ import annotations

import pytest
import torch

from experiments.peers import soft_slider_crank as crank

pytestmark = pytest.mark.usefixtures("compiled")

# Exudyn 1.13.6, 48 elements, 6000 steps, at 0.5, 1, ..., 3 s: speed [rad/s], middle [mm], slider [mm].
SPEED = (2.0508, 2.0599, 2.0833, 2.0787, 2.0763, 2.0869)
MIDDLE = (20.27, 22.14, 50.25, 140.20, 237.66, 265.69)
SLIDER = (-98.99, -276.99, -366.73, -348.85, -296.33, -236.27)


@pytest.mark.slow
def test_speed_and_deflection_over_a_turn():
    own = crank.ours(600, 12)
    rows = slice(100, None, 100)
    torch.testing.assert_close(own.speed[rows], torch.tensor(SPEED).double(), rtol=0.0, atol=5e-4)
    torch.testing.assert_close(1e3 * own.deflection[rows], torch.tensor(MIDDLE).double(), rtol=0.0, atol=1.0)
    torch.testing.assert_close(1e3 * own.slider[rows], torch.tensor(SLIDER).double(), rtol=0.0, atol=1.0)


@pytest.mark.slow
def test_bricks_of_mujoco_come_to_the_beam():
    """The first half turn; the file's own twelve bricks are too stiff in bending, more of them less so."""
    pytest.importorskip("mujoco")
    if (path := crank.models()) is None:
        pytest.skip(f"{crank.MODELS} names no folder")
    result = [1e3 * float(crank.mujoco(path, (count, 1, 1)).deflection[1500]) for count in (12, 36)]
    assert result[0] < 0.6 * MIDDLE[2]
    assert 0.85 * MIDDLE[2] < result[1] < MIDDLE[2]
