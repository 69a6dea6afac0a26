"""The mode of gradients by its estimated cost: few numbers go backwards, also by fewer variables."""

from __future__ import annotations

import pytest

from torchmbd.design.gradient_mode import cheaper_mode


@pytest.mark.parametrize("variables", [1, 3, 30])
def test_few_numbers_are_cheaper_backwards(variables):
    """Forward mode costs two simulations before the first variable."""
    assert [cheaper_mode(variables, numbers) for numbers in (1, 2, 4)] == ["reverse"] * 3


def test_many_numbers_are_cheaper_forwards():
    assert cheaper_mode(3, 100) == "forward"
    assert cheaper_mode(300, 100) == "reverse"


def test_more_variables_never_turn_to_forward_and_more_numbers_never_to_reverse():
    modes = [[cheaper_mode(n, k) == "reverse" for n in range(1, 200)] for k in range(1, 200)]
    assert all(sorted(row) == row for row in modes)
    assert all(sorted(column, reverse=True) == list(column) for column in zip(*modes, strict=True))
