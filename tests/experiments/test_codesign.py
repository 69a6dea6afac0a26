"""The tutorial that trains a controller together with a laminate."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from experiments.tutorial import codesign

SHORT = {"duration": codesign.DURATION, "steps": 40}


@pytest.mark.thorough
def test_gradient_by_weights_and_angles_is_that_of_differences():
    """Along one direction of all parameters at once, and along the angles alone."""
    system = codesign.build(width=8)
    value = codesign.loss(mbd.simulate(system, **SHORT).require_ok())
    value.backward()
    make = torch.Generator().manual_seed(4)
    own = dict(system.named_parameters())
    everything = {
        n: torch.randn(x.shape, generator=make, dtype=x.dtype) * (0.1 + x.detach().abs()) for n, x in own.items()
    }
    angles = {n: x for n, x in everything.items() if n.startswith("arm")}
    for direction in (everything, angles):
        expected = sum(float((own[n].grad * d).sum()) for n, d in direction.items())
        step, result = 1e-5, []
        for sign in (1.0, -1.0):
            designs = {n: own[n].detach() + sign * step * d for n, d in direction.items()}
            with torch.no_grad():
                result.append(float(codesign.loss(mbd.simulate(system, designs=designs, **SHORT))))
        assert_close((result[0] - result[1]) / (2.0 * step), expected, rtol=1e-5, atol=1e-12)


@pytest.mark.slow  # half a minute
def test_training_brings_the_tool_nearer_to_its_goal():
    system = codesign.build()
    assert sum(x.numel() for x in system.parameters()) > 9700
    history = codesign.train(system, iterations=4)
    assert history[-1] < 0.8 * history[0]
