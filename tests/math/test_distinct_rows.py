"""Distinct rows against `torch.unique`, and the first row of each kind."""

import torch

from torchmbd.math.distinct_rows import distinct_rows


def test_rows_are_those_of_unique_in_its_order():
    x = torch.randint(-2, 2, (60, 3), generator=torch.Generator().manual_seed(3)).double()
    first, number = distinct_rows(x)
    rows, expected = torch.unique(x, dim=0, return_inverse=True)
    assert torch.equal(x[first], rows)
    assert torch.equal(number, expected)
    assert all(int((number == k).nonzero()[0]) == int(place) for k, place in enumerate(first))


def test_no_rows():
    first, number = distinct_rows(torch.zeros(0, 2))
    assert len(first) == len(number) == 0
