"""Padding is found, and stands above all frequencies."""

import torch

from torchmbd.fem.reduction.padding import is_padding, with_stiff_padding


def test_padding_has_no_stiffness_until_it_is_given_the_largest():
    Kr = torch.diag(torch.tensor([2.0, 5.0, 0.0, 0.0], dtype=torch.float64))
    Kr[0, 1] = Kr[1, 0] = 1.0
    assert is_padding(Kr).tolist() == [False, False, True, True]
    values = torch.linalg.eigvalsh(with_stiff_padding(Kr))
    torch.testing.assert_close(values[:2], torch.linalg.eigvalsh(Kr[:2, :2]))
    assert values[2] > values[1]
