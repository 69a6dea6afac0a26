"""Statistics of lanes that another integration replaces."""

from __future__ import annotations

import torch
from torch.testing import assert_close

from torchmbd.integrate.statistics import Statistics


def test_numbers_of_lanes_that_are_new_are_those_of_all_lanes():
    result = Statistics()
    result.replace_lanes([0], Statistics(tangent_error=torch.tensor([3.0], dtype=torch.float64)), [0], 1, 3)
    assert result.tangent_error is not None
    assert_close(result.tangent_error, torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64))


def test_valid_times_are_those_of_the_steps_that_were_asked_for():
    result = Statistics(valid_times=torch.tensor([3, 5]), turn=torch.tensor([2.0, 0.1], dtype=torch.float64))
    other = Statistics(valid_times=torch.tensor([9]), turn=torch.tensor([0.2], dtype=torch.float64))
    result.replace_lanes([0], other, [0], 2, 2)
    assert result.numbers()["valid_times"].tolist() == [5, 5]
    assert result.numbers()["turn"].tolist() == [0.2, 0.1]
