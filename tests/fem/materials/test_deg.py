"""deg(): degrees to float64 radians, whatever comes in."""

import math

import pytest
import torch

from torchmbd.math.angles import deg


@pytest.mark.parametrize("degrees", [90, 90.0, torch.tensor(90.0), torch.tensor(90)])
def test_scalars(degrees):
    assert deg(degrees).item() == pytest.approx(math.pi / 2, rel=1e-15)
    assert deg(degrees).dtype == torch.float64


def test_lists_keep_their_shape():
    assert deg([[45, -45, 0]]).tolist() == [[math.pi / 4, -math.pi / 4, 0.0]]
