"""Lanes of the same matrices are solved once, groups of lanes on threads, and every lane keeps its own derivatives."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch.func import jvp

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.fem.reduction import cut, modal_basis, shared_modes
from torchmbd.fem.reduction.dense import DenseModes
from torchmbd.fem.reduction.shared_modes import distinct
from torchmbd.math.threads import GROUP

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


def directions(K: torch.Tensor, M: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """dK, dM and the cotangents of four modes and their stiffness."""
    make = torch.Generator().manual_seed(5)
    dK, dM, G, H = (
        torch.randn(len(K), *shape, generator=make, dtype=torch.float64) for shape in ((12, 12), (12,), (12, 4), (4, 4))
    )
    return dK + dK.mT, dM, G, H


def answers(K, M, dK, dM, *G, more=0):
    """Modes of one cut, their tangents, and the cotangents of K and M."""
    reduce = partial(modal_basis, n=4 - more, more=more)
    values, tangents = jvp(lambda K, M: tuple(reduce(K, M)), (K, M), (dK, dM))[:2]
    K, M = K.clone().requires_grad_(), M.clone().requires_grad_()
    return *values, *tangents, *torch.autograd.grad(reduce(K, M), (K, M), G)


def test_values_and_derivatives_are_those_of_lanes_alone(solved):
    K, M = matrices(LANES)
    numbers = K, M, *directions(K, M)
    together = answers(*numbers)
    assert solved == [3, 3]
    for k in range(len(LANES)):
        for result, expected in zip(together, answers(*(x[k : k + 1] for x in numbers)), strict=True):
            torch.testing.assert_close(result[k], expected[0], rtol=1e-12, atol=1e-12)


def test_groups_on_threads_have_the_bits_of_one_thread_and_the_values_of_one_group(solved, monkeypatch):
    lanes = 2 * GROUP + 3
    K, M = matrices([0] * lanes)
    K = K + torch.diag_embed(torch.linspace(0.0, 3.0, lanes, dtype=torch.float64)[:, None] * torch.arange(12.0))
    K[GROUP, :2] = K[GROUP, :, :2] = 0.0
    K[GROUP, :2, :2], M[GROUP, :2] = (
        torch.eye(2, dtype=torch.float64),
        1.0,
    )  # a cluster: this lane retains another number
    numbers = K, M, *directions(K, M)
    results = []
    for count in (1, 2, 3):
        with mbd.threads(count):
            results.append(answers(*numbers, more=2))
    assert max(solved) <= GROUP
    assert 0 < (results[0][0][:, :, -1] == 0.0).all(1).sum() < lanes  # lanes retain different numbers
    for result in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], result, strict=True))
    monkeypatch.setattr(shared_modes, "lane_groups", lambda lanes: [slice(0, lanes)])
    for result, expected in zip(results[0], answers(*numbers, more=2), strict=True):
        torch.testing.assert_close(result, expected, rtol=1e-11, atol=1e-11)


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
    for designs, lane in (([0, 0, 1, 1, 2], 4), (list(range(3)) * (GROUP // 2), GROUP + 4)):
        K, M = matrices(designs)
        K = K + torch.arange(float(len(K)))[:, None, None] // 2 * torch.eye(12)  # pairs of lanes are equal
        M = torch.diag_embed(M)
        M[lane, 0, 1] = M[lane, 1, 0] = 100.0
        with refused("M", ANY, f"lane {lane}"):
            modal_basis(K, M, 2)
