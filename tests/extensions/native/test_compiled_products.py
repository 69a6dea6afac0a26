"""Compiled products against those of torch, for sizes that fill no tile."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest
import torch

import torchmbd as mbd
from torchmbd.extensions.native.compiled_products import CompiledProducts, Factor, compiled_products
from torchmbd.fem.reduction.lanczos import Recurrence
from torchmbd.math.sparse import Pattern, SparseMatrix

pytestmark = pytest.mark.usefixtures("compiled")
COLUMNS = [1, 5, 8, 9, 17, 24, 45]


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(sum(shape)))


def code() -> CompiledProducts:
    result = compiled_products(random(1))
    assert result is not None
    return result


def close(found: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(
        found, expected, rtol=0, atol=1e-13 * max(expected.abs().flatten().tolist(), default=0.0)
    )


def stored(sizes: tuple[int, ...], lanes: int = 3) -> tuple[list[int], torch.Tensor, torch.Tensor]:
    """Bounds, storage and all numbers of a block-tridiagonal matrix."""
    bounds = [0, *torch.tensor(sizes).cumsum(0).tolist()]
    A, diagonal, lower = torch.zeros(lanes, bounds[-1], bounds[-1], dtype=torch.float64), [], []
    for i, size in enumerate(sizes):
        here, D = slice(bounds[i], bounds[i + 1]), random(lanes, size, size)
        A[:, here, here] = D @ D.mT + 3 * size * torch.eye(size, dtype=torch.float64)
        diagonal.append(A[:, here, here].flatten(1))
        if i:
            B, before = random(lanes, size, sizes[i - 1]), slice(bounds[i - 1], bounds[i])
            A[:, here, before], A[:, before, here] = B, B.mT
            lower.append(B.flatten(1))
    return bounds, torch.cat(diagonal + lower, 1), A


def factored(sizes: tuple[int, ...]) -> tuple[Factor, torch.Tensor]:
    """Factors of a block-tridiagonal matrix, and its inverse."""
    bounds, flat, A = stored(sizes)
    factor = Factor(bounds, flat)
    pivot = code().factorize(factor)
    L = torch.linalg.cholesky(A)
    close(pivot, (L.diagonal(dim1=1, dim2=2) ** 2 / A.diagonal(dim1=1, dim2=2)).amin(1))
    return factor, A.inverse()


def test_a_lane_that_is_not_definite_is_marked() -> None:
    bounds, flat, _ = stored((7, 9, 3))
    flat[1, 49 + 10 * 4] = -1.0
    pivot = code().factorize(Factor(bounds, flat))
    assert pivot[1] == -1.0
    assert (pivot[[0, 2]] > 0.0).all()


@pytest.mark.parametrize("p", COLUMNS)
@pytest.mark.parametrize("sizes", [(7,), (30, 30, 24), (5, 13, 1, 26)])
def test_solve(sizes: tuple[int, ...], p: int) -> None:
    factor, inverse = factored(sizes)
    X = random(3, p, sum(sizes)).mT
    close(code().solve(factor, X), inverse @ X)


@pytest.mark.parametrize("p", [0, *COLUMNS])
def test_solve_supernodes(p: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of 1 to 9 rows in a ring, whose factor has supernodes of many widths; also with strips on threads."""
    monkeypatch.setattr(import_module(CompiledProducts.__module__), "SMALL", 0)
    block = torch.repeat_interleave(torch.arange(12), torch.tensor([3, 1, 9, 2, 6, 4, 5, 1, 7, 8, 2, 4]))
    near = (block[:, None] - block).abs() % 11 <= 1
    N, B = len(block), random(len(block), len(block))
    pattern = Pattern(near.nonzero()[:, 0], near.nonzero()[:, 1], N)
    A = torch.where(near, B + B.mT, 0.0) + 40.0 * torch.eye(N, dtype=torch.float64)
    nodes = code().supernodes(pattern, torch.from_numpy(np.random.default_rng(p).permutation(N)))
    L, pivot = code().factorize_supernodes(nodes, pattern, A[pattern.rows, pattern.cols])
    order = nodes.order
    squares = torch.linalg.cholesky(A[order][:, order]).diagonal() ** 2
    close(torch.tensor(pivot, dtype=torch.float64), (squares / A.diagonal()[order]).min())
    X = random(N, p)
    solutions = []
    for count in (1, 3):
        with mbd.threads(count):
            solutions.append(code().solve_supernodes(nodes, L, X))
    assert torch.equal(*solutions)
    close(solutions[0], torch.linalg.solve(A, X))


def test_supernodes_merge_where_few_zeros_are_added() -> None:
    """A chain: columns have two entries, so that three zeros make one supernode of four columns."""
    near = (torch.arange(9)[:, None] - torch.arange(9)).abs() <= 1
    nodes = code().supernodes(Pattern(near.nonzero()[:, 0], near.nonzero()[:, 1], 9), torch.arange(9))
    assert int(nodes.start[-1]) == int((nodes.first.diff() * (nodes.first.diff() + 1) // 2).sum()) + int(
        (nodes.first.diff() * nodes.below_start.diff()).sum()
    )
    assert nodes.first.diff().max() >= 4
    assert all((nodes.below >= 1) & (nodes.below < 9))


def test_a_pivot_that_is_not_positive() -> None:
    near = (torch.arange(40)[:, None] - torch.arange(40)).abs() % 38 <= 2
    pattern = Pattern(near.nonzero()[:, 0], near.nonzero()[:, 1], 40)
    A = torch.where(pattern.rows == pattern.cols, 9.0, 1.0).double()
    A[pattern.diagonal[23]] = -1.0
    nodes = code().supernodes(pattern, torch.arange(40).flip(0))
    assert code().factorize_supernodes(nodes, pattern, A)[1] == -1.0


@pytest.mark.parametrize("p", COLUMNS)
def test_multiply_sparse(p: int) -> None:
    near = random(29, 29).abs() > 1
    pattern = Pattern((near | near.mT).nonzero()[:, 0], (near | near.mT).nonzero()[:, 1], 29)
    values, X = random(2, 3, pattern.nnz), random(2, 29, p)
    close(code().multiply_sparse(pattern, values, X), SparseMatrix(pattern, values) @ X[:, None])


@pytest.mark.parametrize("p", COLUMNS)
def test_pair(p: int) -> None:
    near = random(29, 29).abs() > 1
    pattern = Pattern((near | near.mT).nonzero()[:, 0], (near | near.mT).nonzero()[:, 1], 29)
    Y, X = random(2, 3, 29, p), random(2, 29, p)
    close(code().products_at_pattern(pattern, Y, X), (Y @ X[:, None].mT)[..., pattern.rows, pattern.cols])


def started(p: int, lanes: int = 3) -> Recurrence:
    return Recurrence(torch.linalg.qr(random(lanes, 55, p))[0])


def far(X: torch.Tensor) -> float:
    """How far columns are from orthonormal ones."""
    return float((X.mT @ X - torch.eye(X.shape[2], dtype=X.dtype)).abs().max())


@pytest.mark.parametrize("p", [1, 5, 8, 9])
def test_lanczos(p: int) -> None:
    """The recurrence of torch's steps, in two goes; H Q = Q T + X R e'."""
    factor, inverse = factored((12, 30, 13))
    G = random(3, 55, 1).abs() + 0.5
    H = G * inverse * G.mT
    ours, torchs = started(p), started(p)
    torchs.reserve(4)
    torchs.extend(lambda X: H @ X, 4)
    for end in (1, 4):
        ours.reserve(end)
        code().lanczos(factor, G, ours.steps, end, ours.Q, ours.T, ours.X, ours.R)
        ours.steps = end
    T = ours.T.triu()
    close(T.abs(), torchs.T.triu().abs())  # columns have signs of their own
    T = T + T.triu(1).mT
    close(H @ ours.Q, ours.Q @ T + torch.cat([torch.zeros_like(ours.Q[..., p:]), ours.X @ ours.R], 2))
    assert far(torch.cat([ours.Q, ours.X], 2)) < 1e-13


def test_lanczos_stays_orthonormal_where_nothing_new_is_left() -> None:
    """All vectors are eigenvectors: after the first block there is rounding only."""
    one = torch.ones(1, 55, 1, dtype=torch.float64)
    factor = Factor((0, 55), torch.eye(55, dtype=torch.float64).reshape(1, -1))
    result = started(8, lanes=1)
    result.reserve(3)
    code().lanczos(factor, one, 0, 3, result.Q, result.T, result.X, result.R)
    assert far(result.Q) < 1e-13
    assert far(result.X) < 1e-13


@pytest.mark.parametrize("p", COLUMNS)
def test_conjugate_gradients(p: int) -> None:
    """Columns end at different times; those of a zero right-hand side at once."""
    factor, inverse = factored((12, 20, 9))
    G = random(3, 41, 1).abs() + 0.5
    H = G * inverse * G.mT
    mu, vectors = torch.linalg.eigh(H)
    U, inverse_mu = vectors[..., -4:], 1 / mu[:, -4:][:, None, torch.arange(p) % 4]
    c = random(3, 41, p) * torch.logspace(0, -9, p, dtype=torch.float64)
    c[..., p // 2] = 0.0
    c = c - U @ (U.mT @ c)
    target = 5e-12 * torch.linalg.vector_norm(c, dim=1, keepdim=True)
    y = torch.zeros_like(c)
    assert code().conjugate_gradients(factor, G, U, inverse_mu, target, y, c, 100)
    left = c - y + inverse_mu * (H @ y)
    size = torch.linalg.vector_norm(c, dim=1)
    worst = (torch.linalg.vector_norm(left, dim=1) / size.clamp_min(1e-30)).max()
    assert worst < 1e-10
    assert (y[..., p // 2] == 0.0).all()
    if p > 1:
        assert not code().conjugate_gradients(factor, G, U, inverse_mu, target, torch.zeros_like(c), c, 1)
