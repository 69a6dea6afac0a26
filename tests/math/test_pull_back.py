"""Rows of weights pulled back, against torch.autograd.grad row by row."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from torchmbd.math.pull_back import pull_back


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=torch.float64)


@pytest.mark.parametrize("grad_mode", [True, False])
@pytest.mark.parametrize("rows", [1, 4])
def test_rows_are_those_of_torch_one_by_one(rows: int, grad_mode: bool) -> None:
    x, y, unused = (random(*shape).requires_grad_() for shape in ((5, 3), (3,), (2,)))
    outputs = [(x**3).sum(0) * y, x.sin().sum()[None]]
    weights = [random(rows, 3), random(rows, 1)]
    with torch.set_grad_enabled(grad_mode):
        by = pull_back(outputs, [x, y, unused], weights)
    for k in range(rows):
        expected = torch.autograd.grad(outputs, [x, y], [w[k] for w in weights], retain_graph=True)
        torch.testing.assert_close([by[0][k], by[1][k]], list(expected), rtol=1e-15, atol=0)
    assert torch.equal(by[2], torch.zeros(rows, 2, dtype=torch.float64))


@pytest.mark.thorough
def test_it_imports_no_symbolic_algebra() -> None:
    code = """
import sys, torch
from torchmbd.math.pull_back import pull_back
x = torch.ones(3, dtype=torch.float64, requires_grad=True)
pull_back([x * x], [x], [torch.eye(3, dtype=torch.float64)])
assert "sympy" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
