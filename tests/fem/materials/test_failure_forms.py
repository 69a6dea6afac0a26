"""Indices as forms of few coordinates beside those of the stresses themselves."""

import pytest
import torch
from torch.testing import assert_close

from torchmbd.fem.materials import CRITERIA, FailureForms, Strength

STRENGTHS = torch.stack(
    [
        Strength(1500e6, 1200e6, 50e6, 250e6, 70e6).numbers(),
        Strength(900e6, 700e6, 40e6, 180e6, 60e6, 55e6, 30e6, interaction=-0.2).numbers(),
    ]
)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_forms_are_the_indices_of_the_stresses(criterion):
    make = torch.Generator().manual_seed(5)
    basis = 1e8 * torch.randn(7, 5, 3, generator=make, dtype=torch.float64)
    strength = STRENGTHS[torch.tensor([0, 1, 1, 0, 0, 1, 0])]
    w = torch.randn(11, 3, generator=make, dtype=torch.float64)
    w[4] = 0.0
    stress = torch.einsum("pck,nk->npc", basis, w)
    assert_close(FailureForms(criterion, basis, strength)(w), CRITERIA[criterion](stress, strength))
