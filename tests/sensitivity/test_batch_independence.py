"""What a design gets does not depend on what else is in its batch."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import soft_slider_crank

pytestmark = pytest.mark.usefixtures("compiled")

ANGLES = "rod.laminate.angles"


@pytest.mark.thorough
@pytest.mark.parametrize(("duration", "steps"), [(0.01, 10), (0.004, 12)])
def test_gradients_alone_and_in_a_batch(duration, steps):
    """Coarse steps: some designs call for more corrections of their tangents than others."""
    system = soft_slider_crank()
    designs = mbd.deg([[0.0, 0.0], [90.0, 80.0], [30.0, -20.0], [5.0, 85.0], [45.0, -45.0]])

    def tangents(some: torch.Tensor) -> torch.Tensor:
        motion = mbd.simulate(system, duration, steps=steps, gradients="forward", designs={ANGLES: some})
        assert motion.dq_db is not None
        return motion.dq_db

    together = tangents(designs)
    for k in range(len(designs)):
        alone = tangents(designs[k : k + 1])[0]
        assert_close(together[k], alone, rtol=0, atol=1e-8 * float(alone.abs().max()))


@pytest.mark.thorough
def test_adjoints_alone_and_in_a_batch():
    """Steps so coarse that some designs call for more corrections of their cotangents: others do not get these."""
    system = soft_slider_crank()
    designs = mbd.deg([[0.0, 0.0], [90.0, 80.0], [30.0, -20.0], [45.0, -45.0]])

    def gradients(some: torch.Tensor) -> torch.Tensor:
        angles = some.clone().requires_grad_()
        options = {"gradients": "reverse", "backend": "eager", "halvings": 0}
        motion = mbd.simulate(system, 0.02, steps=10, designs={ANGLES: angles}, **options)
        total = (motion.q * torch.arange(1.0, motion.q.shape[2] + 1.0, dtype=torch.float64)).sum()
        return torch.autograd.grad(total + 1e-3 * motion.v.sum(), angles)[0]

    together = gradients(designs)
    for k in range(len(designs)):
        alone = gradients(designs[k : k + 1])[0]
        assert_close(together[k], alone, rtol=0, atol=2e-11 * float(alone.abs().max()))
