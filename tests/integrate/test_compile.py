"""torch.compile of a function with a motion in it: the motion runs as it is, the rest is compiled."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor

SYSTEM, ENERGY = mbd.examples.arm(), mbd.Max(mbd.StrainEnergy("arm"))


def loss(x: Tensor) -> Tensor:
    motion = mbd.simulate(SYSTEM, 0.02, steps=4, designs={"arm.laminate.angles": 2.0 * torch.sin(x)})
    return ENERGY(motion).sum() * x.square().sum()


@pytest.mark.thorough
def test_value_and_gradient_are_those_of_the_function_itself():
    result, graphs = [], []

    def backend(graph: torch.fx.GraphModule, _: list[Tensor]) -> torch.fx.GraphModule:
        graphs.append(graph)
        return graph

    for f in (loss, torch.compile(loss, backend=backend)):
        x = tensor(0.3, 0.4).requires_grad_()
        y = f(x)
        result.append((y.detach(), *torch.autograd.grad(y, x)))
    assert_close(result[1], result[0], rtol=1e-12, atol=0)
    assert "sin" in graphs[0].code
