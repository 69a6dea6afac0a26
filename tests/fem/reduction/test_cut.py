"""The number of modes of each lane: whole clusters, the widest gap, a function of the lane alone; derivatives of its span."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.fem.reduction import CutCluster, craig_bampton, modal_basis
from torchmbd.fem.reduction.padding import is_padding, with_stiff_padding
from torchmbd.math.sparse import Pattern, SparseMatrix

SPECTRA = [  # the number of modes for n = 2, more = 3
    ([1.0, 2.0, 4.0, 5.0, 6.0, 7.0, 20.0, 30.0], 2),  # an ordinary gap stays, though a wider one follows
    ([1.0, 2.0, 2.0, 5.0, 6.0, 7.0, 20.0, 30.0], 3),
    ([1.0, 2.0, 2.1, 2.2, 2.3, 7.0, 20.0, 30.0], 5),  # a near one is not cut
    ([1.0, 2.0, 2.0, 4.0, 7.9, 7.9, 20.0, 30.0], 3),  # not the gap behind four, which is a little narrower
]


def pencil(rows: list[list[float]], seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Full matrices with these eigenvalues, lane by lane."""
    make = torch.Generator().manual_seed(seed)
    n = len(rows[0])
    A = torch.randn(n, n, generator=make, dtype=torch.float64) + 4.0 * torch.eye(n, dtype=torch.float64)
    return A.T @ torch.diag_embed(torch.tensor(rows, dtype=torch.float64)) @ A, (A.T @ A).repeat(len(rows), 1, 1)


def test_each_lane_is_cut_where_its_gap_is_widest():
    rows, expected = [row for row, _ in SPECTRA], [count for _, count in SPECTRA]
    K, M = pencil(rows)
    basis = modal_basis(K, M, 2, more=3)
    assert (~is_padding(basis.stiffness)).sum(-1).tolist() == expected
    for lane, count in enumerate(expected):
        alone = modal_basis(K[lane], M[lane], 2, more=3)
        assert alone.stiffness.shape[-1] == count
        assert_close(basis.stiffness[lane, :count, :count], alone.stiffness)
        assert_close(basis.vectors[lane, :, :count], alone.vectors, rtol=1e-9, atol=1e-9)
        assert not basis.vectors[lane, :, count:].any()


def test_an_ordinary_gap_keeps_the_number_and_nothing_else_changes():
    K, M = pencil([SPECTRA[0][0]])
    for x, y in zip(modal_basis(K, M, 2), modal_basis(K, M, 2, more=4), strict=True):
        assert torch.equal(x, y)


def _function(K, M, reduce):
    """A function of the span: the response to a load, and a mass."""
    basis = reduce(K, M)
    load = torch.linspace(1.0, 2.0, K.shape[-1], dtype=K.dtype)
    rows = (basis.vectors.mT @ load)[..., None]
    return (rows.mT @ torch.linalg.solve(with_stiff_padding(basis.stiffness), rows))[
        ..., 0, 0
    ] + basis.vectors.square().sum((-2, -1))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "reduce",
    [
        lambda K, M: modal_basis(K, M, 2, more=3),
        lambda K, M: craig_bampton(K, M, 1, [2, 0], more=3),
    ],
    ids=["vibration", "craig-bampton"],
)
def test_derivatives_are_those_of_each_lane_alone(reduce):
    """Forward, reverse and differences, of lanes with different numbers and of each alone."""
    K, M = pencil([[1.0, 1.9, 4.0, 5.0, 6.3, 7.0, 20.0, 30.0], [1.0, 2.0, 2.08, 5.0, 6.0, 9.0, 20.0, 30.0]], seed=2)
    dK, dM = (
        x + x.mT for x in torch.randn(2, *K.shape, generator=torch.Generator().manual_seed(7), dtype=K.dtype) * 0.1
    )
    value, forward = torch.func.jvp(lambda K, M: _function(K, M, reduce), (K, M), (dK, dM))
    K_, M_ = K.clone().requires_grad_(), M.clone().requires_grad_()
    gK, gM = torch.autograd.grad(_function(K_, M_, reduce).sum(), (K_, M_))
    assert_close((gK * dK + gM * dM).sum((-2, -1)), forward, rtol=1e-9, atol=1e-10)
    h = 1e-5
    difference = (_function(K + h * dK, M + h * dM, reduce) - _function(K - h * dK, M - h * dM, reduce)) / (2 * h)
    assert_close(forward, difference, rtol=1e-6, atol=1e-7)
    for lane in range(2):
        assert_close(_function(K[lane], M[lane], reduce), value[lane], rtol=1e-10, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("n", [3, 5])
def test_large_sparse_lanes_are_cut_as_dense_ones(n):
    """Two equal chains beside each other have every eigenvalue twice; in the other lane one of them is stiffer."""
    size = 200
    i = torch.arange(size)
    near = ((i[:, None] - i).abs() <= 1) & ~(
        (torch.minimum(i[:, None], i) == 99) & (torch.maximum(i[:, None], i) == 100)
    )
    pattern = Pattern(near.nonzero()[:, 0], near.nonzero()[:, 1], size)
    on = pattern.rows == pattern.cols
    twice = torch.where(on, 2.0, -1.0).double()
    values = torch.stack([twice, torch.where(pattern.rows >= 100, 1.7 * twice, twice)])
    K = SparseMatrix(pattern, values, symmetric=True)
    M = torch.ones(2, size, dtype=torch.float64)
    sparse = modal_basis(K, M, n, more=4)
    dense = torch.zeros(2, size, size, dtype=torch.float64)
    dense[:, pattern.rows, pattern.cols] = values
    full = modal_basis(dense, M, n, more=4)
    assert len(set((~is_padding(full.stiffness)).sum(-1).tolist())) == 2
    assert_close(sparse.stiffness, full.stiffness, rtol=1e-9, atol=0)
    x = values.clone().requires_grad_()
    span = modal_basis(SparseMatrix(pattern, x, symmetric=True), M, n, more=4).vectors
    full_x = dense.clone().requires_grad_()
    span_of_full = modal_basis(full_x, M, n, more=4).vectors
    load = torch.linspace(0.0, 1.0, size, dtype=torch.float64)
    (g,) = torch.autograd.grad((span.mT @ load).square().sum(), x)
    (g_full,) = torch.autograd.grad((span_of_full.mT @ load).square().sum(), full_x)
    assert_close(g[:, on], g_full.diagonal(dim1=1, dim2=2)[:, pattern.rows[on]], rtol=1e-6, atol=1e-8)


def test_a_cluster_that_is_wider_than_allowed_says_the_number():
    K, M = (
        torch.diag(torch.tensor([1.0] * 7 + [3.0, 4.0, 9.0], dtype=torch.float64)),
        torch.ones(10, dtype=torch.float64),
    )
    with refused("modes", 2, "2 to 7", "modes = 7", kind=CutCluster) as error:
        modal_basis(K, M, 2, more=4)
    assert isinstance(error.value, InputError)
    assert error.value.beyond == 7
    assert modal_basis(K, M, 3, more=4).stiffness.shape[-1] == 7
    ordinary = torch.diag(torch.arange(1.0, 11.0, dtype=torch.float64))
    with refused("modes", 2, "lane 1", kind=CutCluster) as error:
        modal_basis(torch.stack([ordinary, K]), M, 2, more=4)
    assert error.value.lanes == (1,)
