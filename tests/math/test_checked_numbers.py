"""Arrays of a user become one's own, or are refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import indices, nonnegative, positive, reals, scalar


@pytest.mark.parametrize("given", [[1, 2], (1.0, 2.0), np.array([1, 2]), torch.tensor([1.0, 2.0]), range(1, 3)])
def test_kinds(given):
    for read, dtype in ((reals, torch.float64), (indices, torch.int64)):
        assert read("x", given).dtype is dtype
        assert read("x", given).tolist() == [1, 2]


def test_a_later_change_of_the_argument_changes_nothing():
    for given in (np.array([1.0, 2.0]), torch.tensor([1.0, 2.0], dtype=torch.float64)):
        own = reals("x", given)
        given[0] = 5.0
        assert own.tolist() == [1.0, 2.0]


def test_what_is_none_is_named():
    with pytest.raises(InputError) as error:
        reals("x", "steel")
    assert (error.value.path, error.value.value) == (("x",), "steel")
    with refused("x", [[1, 2], [3]]):
        indices("x", [[1, 2], [3]])
    with refused("x"):
        indices("x", [1.0, 1.5])
    with refused("x", [1j]):
        reals("x", [1j])
    with refused("x"):
        indices("x", [1.0, float("nan")])


def test_numbers_that_are_none_are_named():
    for given in (None, "1", True, [1.0], 1j, float("nan"), torch.ones(2)):
        with refused("mass of 'rod'"):
            positive("mass of 'rod'", given, "kg")
    for read in (lambda x: positive("mass", x, "kg"), lambda x: reals("mass", [0.0, x]), lambda x: indices("mass", x)):
        with refused("mass"):
            read(torch.ones((), requires_grad=True))
    assert (positive("x", torch.tensor(2.0), "m"), scalar("x", -3)) == (2.0, -3.0)


@pytest.mark.parametrize("read", [positive, nonnegative])
def test_a_value_without_a_unit_has_no_blank_behind_it(read):
    with refused("deviation", -1.0) as caught:
        read("deviation", -1.0, "")
    assert " ;" not in str(caught.value)
