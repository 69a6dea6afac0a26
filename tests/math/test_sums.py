"""Sums of chosen numbers beside the same with a matrix."""

from __future__ import annotations

import pytest
import torch

from torchmbd.math.sums import Sums

ROWS, TERMS = torch.tensor([4, 0, 0, 2, 4, 4, 2]), torch.tensor([1, 3, 3, 0, 2, 1, 5])
MATRIX = torch.zeros(6, 7, dtype=torch.float64).index_put((ROWS, TERMS), torch.ones(7).double(), accumulate=True)


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(sum(shape)))


@pytest.mark.usefixtures("products")
def test_the_map_and_its_transpose() -> None:
    sums, x, y = Sums.of(ROWS, TERMS, (6, 7)), random(3, 7), random(3, 6)
    torch.testing.assert_close(sums(x), x @ MATRIX.T)
    torch.testing.assert_close(sums.adjoint(y)[0], y @ MATRIX)


@pytest.mark.usefixtures("products")
def test_chosen_rows() -> None:
    chosen = torch.tensor([2, 4, 1, 4])
    sums, x, y = Sums.of(ROWS, TERMS, (6, 7)).selected(chosen), random(3, 7), random(3, 4)
    torch.testing.assert_close(sums(x), x @ MATRIX[chosen].T)
    torch.testing.assert_close(sums.adjoint(y)[0], y @ MATRIX[chosen])
