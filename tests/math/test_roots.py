"""Roots between ends of different signs: closed forms, jumps, ends that are roots, functions without a change of sign."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from tests.mechanisms import tensor
from torchmbd.math.roots import roots


def solved(f, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, list[int]]:
    """Roots, which were found, and how many numbers were tried of each."""
    tried = [0] * len(low)

    def some_of(x: Tensor, numbers: list[int]) -> Tensor:
        for k in numbers:
            tried[k] += 1
        return torch.stack([f(y, k) for y, k in zip(x, numbers, strict=True)])

    every = range(len(low))
    ends = (torch.stack([f(x[k], k) for k in every]) for x in (low, high))
    return *roots(some_of, low, high, *ends), tried


def test_smooth_functions_of_several_lanes_have_the_roots_of_closed_forms_in_few_evaluations():
    levels = tensor(0.1, 0.5, 0.9)
    x, success, tried = solved(lambda y, k: torch.sin(y) - levels[k], tensor(0.0, 0.0, 0.0), tensor(1.5, 1.5, 1.5))
    assert success.all()
    assert_close(x, torch.asin(levels), rtol=1e-12, atol=0)
    assert max(tried) <= 9


def test_nearly_linear_functions_take_four_evaluations():
    """As events in short steps."""
    x, success, tried = solved(lambda y, _: 1.0 - y - 0.01 * y * y, tensor(0.0), tensor(2.0))
    assert success.all()
    assert_close(x, tensor((1.04**0.5 - 1.0) / 0.02), rtol=1e-13, atol=0)
    assert max(tried) <= 4


def test_a_function_that_jumps_has_its_root_at_the_jump():
    x, success, _ = solved(lambda y, _: torch.where(y < 0.3, 1.0, -2.0).double(), tensor(0.0), tensor(1.0))
    assert success.all()
    assert_close(x, tensor(0.3), rtol=1e-12, atol=0)


def test_a_triple_root():
    x, success, _ = solved(lambda y, _: (y - 0.2) ** 3, tensor(0.0), tensor(1.0))
    assert success.all()
    assert_close(x, tensor(0.2), rtol=1e-4, atol=0)


def test_an_end_that_is_a_root_is_evaluated_once_and_a_little_before():
    x, success, tried = solved(lambda y, _: 1.0 - y, tensor(0.0), tensor(1.0))
    assert (x.item(), success.item(), tried) == (1.0, True, [2])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("high", "after"), [(1.0, 0.0), (0.8, 0.0), (1.0, 1.0)])
def test_a_function_that_stays_zero_has_its_root_where_it_gets_there(sign, high, after):
    """max(0, 0.3 - x), and a dead zone from 0.3 to 0.7; the function has a slope at the root."""

    def f(x: Tensor, _: int) -> Tensor:
        return sign * ((0.3 - x).clamp_min(0.0) - after * (x - 0.7).clamp_min(0.0))

    x, success, tried = solved(f, tensor(0.0, 0.0), tensor(high, high))
    assert success.all()
    assert_close(x, tensor(0.3, 0.3), rtol=0, atol=2e-9)
    assert bool((x < 0.3).all())
    assert max(tried) <= 50


def test_signs_that_do_not_differ_and_numbers_that_are_none_are_not_found():
    functions = [lambda y: 1.0 + y, lambda y: torch.where((y > 0.0) & (y < 1.0), torch.nan, 0.5 - y)]
    _, success, _ = solved(lambda y, k: functions[k](y), tensor(0.0, 0.0), tensor(1.0, 1.0))
    assert not success.any()
