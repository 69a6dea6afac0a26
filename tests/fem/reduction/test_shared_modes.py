"""Lanes of the same matrices are solved once, and every lane keeps its own derivatives."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch.func import jvp

from torchmbd.errors import InputError
from torchmbd.fem.reduction import cut, modal_basis
from torchmbd.fem.reduction.dense import DenseModes
from torchmbd.fem.reduction.shared_modes import distinct

LANES = [0, 1, 0, 2, 1, 0]  # which design a lane is


def matrices(lanes: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
    make = torch.Generator().manual_seed(3)
    A = torch.randn(3, 12, 12, generator=make, dtype=torch.float64)
    return (A @ A.mT + torch.eye(12, dtype=torch.float64))[lanes], (1.0 + A[:, 0].abs())[lanes]


@pytest.fixture
def solved(monkeypatch) -> list[int]:
    """The number of lanes of each eigenproblem that is solved."""
    counts: list[int] = []

    def counted(K_form, M_form, K, M, n):
        counts.append(len(K))
        return DenseModes(K_form, M_form, K, M, n)

    monkeypatch.setattr(cut, "DenseModes", counted)
    return counts


def test_values_and_derivatives_are_those_of_lanes_alone(solved):
    K, M = matrices(LANES)
    make = torch.Generator().manual_seed(5)
    dK, dM = (torch.randn(x.shape, generator=make, dtype=torch.float64) for x in (K, M))
    dK = dK + dK.mT
    G = [torch.randn(*shape, generator=make, dtype=torch.float64) for shape in ((6, 12, 4), (6, 4, 4))]

    def answers(K, M, dK, dM, *G):
        reduce = partial(modal_basis, n=4)
        values, tangents = jvp(lambda K, M: tuple(reduce(K, M)), (K, M), (dK, dM))[:2]
        K, M = K.clone().requires_grad_(), M.clone().requires_grad_()
        return *values, *tangents, *torch.autograd.grad(reduce(K, M), (K, M), G)

    together = answers(K, M, dK, dM, *G)
    assert solved == [3, 3]
    for k in range(len(LANES)):
        for result, expected in zip(together, answers(*(x[k : k + 1] for x in (K, M, dK, dM, *G))), strict=True):
            torch.testing.assert_close(result[k], expected[0], rtol=1e-12, atol=1e-12)


def test_lanes_differ_by_either_matrix_and_by_more_than_the_sum_of_their_numbers():
    K = torch.tensor([[1.0, 2.0], [2.0, 1.0], [1.0, 2.0], [1.0, 2.0], [2.0, 1.0]], dtype=torch.float64)
    M = torch.tensor([1.0, 1.0, 1.0, 2.0, 1.0], dtype=torch.float64)[:, None]
    first, index = distinct(K, M)
    assert [first[i].item() for i in index][::2] == [0, 0, 4]
    for one, other in torch.combinations(torch.arange(5)).tolist():
        if index[one] == index[other]:
            assert torch.equal(K[one], K[other])
            assert torch.equal(M[one], M[other])


def test_an_error_names_a_lane_of_all():
    K, M = matrices([0, 0, 1, 1, 2])
    M = torch.diag_embed(M)
    M[4, 0, 1] = M[4, 1, 0] = 100.0
    with pytest.raises(InputError, match="lane 4"):
        modal_basis(K, M, 2)
