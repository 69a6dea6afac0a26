"""A long slider-crank in modal parts against exact beams."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from experiments.peers import modal_slider_crank as crank

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.slow
def test_modal_parts_move_as_exact_beams():
    """Coarser than the page: 400 steps of the first two seconds."""
    result = []
    for system, rod in ((crank.parts(modes=4), crank.IN_PARTS), (crank.exact((10, 20)), crank.of_exact(20))):
        motion = mbd.simulate(system, 2.0, steps=400, gradients="none").require_ok()
        result.append(crank.observed(motion, rod))
    (bent, slider), (bent_exactly, slider_exactly) = result
    assert float(bent_exactly.abs().max()) > 0.02
    assert float((bent - bent_exactly).abs().max()) < 0.02 * float(bent_exactly.abs().max())
    torch.testing.assert_close(slider, slider_exactly, rtol=0.0, atol=5e-3)
