"""torch.utils.checkpoint takes a system whose first motion, or first equation of motion, is inside it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

import torchmbd as mbd

ENERGY = mbd.Max(mbd.StrainEnergy("arm"))


def by_equation(system: mbd.System) -> Tensor:
    f = system()
    return f(0.0, f.initial_state() + 1e-3).square().sum()


LOSSES = {
    "motion": lambda s: ENERGY(mbd.simulate(s, 0.02, steps=10)).sum(),
    "forward": lambda s: ENERGY(mbd.simulate(s, 0.02, steps=10, gradients="forward")).sum(),
    "equilibrium": lambda s: ENERGY(mbd.simulate(s, 0.02, steps=10, start="equilibrium")).sum(),
    "phases": lambda s: ENERGY(mbd.simulate(s, 0.02, steps=10, phases=[mbd.Phase(until=0.01), mbd.Phase()])).sum(),
    "equation": by_equation,
}


@pytest.mark.thorough
@pytest.mark.parametrize("loss", LOSSES)
def test_the_gradient_is_that_without_it(loss):
    result = []
    for use in (True, False):
        system = mbd.examples.arm()
        angles = system.get_parameter("arm.laminate.angles")
        one = torch.zeros(1, requires_grad=True)

        def run(_: Tensor, system: mbd.System = system) -> Tensor:
            return LOSSES[loss](system)

        (checkpoint(run, one, use_reentrant=False) if use else run(one)).backward()
        result.append(angles.grad)
    assert float(result[0].norm()) > 0.0
    assert torch.equal(*result)
