"""The benchmark of exact beams: the same motion in both codes, and gradients that are those of the public functions."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from experiments.benchmark.beams import DURATION, deflection, off_the_chord, peer, slider_crank
from experiments.benchmark.cases import motion, motion_backwards

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.thorough
@pytest.mark.parametrize(("cable", "apart"), [(True, 0.02), (False, 0.04)])
def test_both_codes_simulate_the_same_mechanism(cable, apart):
    """Exudyn's exact beam of 20 elements is 1.2 % too stiff, its cable has no shear."""
    pytest.importorskip("exudyn")
    case = slider_crank()
    designs = case.designs(1)
    nodes = mbd.simulate(case.system, DURATION, steps=400, designs=designs, gradients="none").body("rod").nodes[0]
    ours = off_the_chord(nodes[:, [0, 10, 20]].movedim(1, 0)).sqrt()
    (run,) = peer(case.system, designs, cable)
    result = torch.from_numpy(run(DURATION, 400).U).sqrt()
    assert float((result - ours).abs().max()) < apart * float(ours.max())


@pytest.mark.thorough
def test_gradients():
    case = slider_crank(2)
    result, by = motion_backwards(case.dynamics(1, gradients=True), DURATION, 200, observed=deflection)
    values = motion(case.dynamics(1, gradients=False), DURATION, 200, deflection)[0]
    torch.testing.assert_close(result, values, rtol=1e-7, atol=0.0)
    angles = case.designs(1)["rod.section.angles"].requires_grad_()
    nodes = mbd.simulate(case.system, DURATION, steps=200, designs={"rod.section.angles": angles}).body("rod").nodes
    history = off_the_chord(nodes[:, :, [0, 1, 2]].movedim(2, 0))
    integral = torch.trapezoid(history, dx=DURATION / 200).sum()
    torch.testing.assert_close(result[1].sum(), integral.detach(), rtol=1e-7, atol=0.0)
    gradient = torch.autograd.grad(integral, angles)[0]
    torch.testing.assert_close(by[1], gradient, rtol=1e-6, atol=1e-6 * float(gradient.abs().max()))
