"""Dailey's method along a line: exact families with every kind of splitting, and his square cantilever."""

import math

import pytest
import torch
from torch.func import jvp

from experiments.models.eigen_families import FAMILIES, Family
from tests.refused import refused
from torchmbd.fem.reduction import eigenpair_branches
from torchmbd.fem.reduction.branches import UNSPLIT

ONE = torch.ones(1, dtype=torch.float64)
ZERO = torch.zeros(1, dtype=torch.float64)
SPLIT = {
    "distinct": [0, 0, 0, 0],
    "crossing of two": [0, 1, 1, 0],
    "crossing of three": [1, 1, 1, 0],
    "equal slopes": [0, 2, 2, 0],
    "always repeated": [0, UNSPLIT, UNSPLIT, 0],
    "partly splitting triple": [1, UNSPLIT, UNSPLIT, 0],
    "free body": [UNSPLIT, UNSPLIT, UNSPLIT, 1, 1],
    "gap 1e-10": [0, 1, 1, 0],
    "gap 1e-8": [0, 1, 1, 0],
    "gap 1e-4": [0, 0, 0, 0],
}
# The distance to the neighbor limits what can be known: as a crossing to O(gap), as distinct to O(rounding / gap^2).
VECTOR_TOLERANCE = {"gap 1e-8": 1e-8, "gap 1e-4": 3e-8}


def branches(family: Family, **options):
    return eigenpair_branches(lambda b: family.exact(b)[:2], ZERO, ONE, family.n, **options)


@pytest.mark.thorough
@pytest.mark.parametrize("name", SPLIT)
@pytest.mark.parametrize("with_mass", [False, True], ids=["", "M(b)"])
def test_every_branch_that_exists_has_its_exact_derivatives(name, with_mass):
    family = next(f for f in FAMILIES if f.name == name and f.with_mass == with_mass)
    result = branches(family)
    assert result.split.tolist() == SPLIT[name]
    (psi, low), (d_psi, d_low) = jvp(lambda b: family.exact(b)[2:], (ZERO,), (ONE,))
    M = family.exact(ZERO)[1]
    overlap = result.vectors.T @ M @ psi
    tolerance = VECTOR_TOLERANCE.get(name, 1e-9)
    slopes = sorted(d_low.diagonal()[result.split == UNSPLIT].tolist()) if name == "free body" else None
    if slopes is not None:
        torch.testing.assert_close(
            result.value_slopes[:3], torch.tensor(slopes, dtype=torch.float64), rtol=0, atol=1e-11
        )
    for i in (result.split != UNSPLIT).nonzero().squeeze(-1).tolist():
        j = int(overlap[i].abs().argmax())
        sign = torch.sign(overlap[i, j])
        torch.testing.assert_close(result.values[i], low[j, j], rtol=1e-9, atol=0)
        torch.testing.assert_close(result.value_slopes[i], d_low[j, j], rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(result.vectors[:, i] * sign, psi[:, j], rtol=0, atol=tolerance)
        torch.testing.assert_close(result.vector_slopes[:, i] * sign, d_psi[:, j], rtol=0, atol=tolerance)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["always repeated", "partly splitting triple"])
def test_what_stays_together_moves_as_a_span(name):
    family = next(f for f in FAMILIES if f.name == name and f.with_mass)
    result = branches(family)
    together = result.split == UNSPLIT
    (psi, low), (d_psi, d_low) = jvp(lambda b: family.exact(b)[2:], (ZERO,), (ONE,))
    pair = [j for j in range(family.n) if low[j, j] == 2.0 and d_low[j, j] == 1.0]
    V, dV, E, dE = result.vectors[:, together], result.vector_slopes[:, together], psi[:, pair], d_psi[:, pair]
    torch.testing.assert_close(V @ V.T, E @ E.T, rtol=0, atol=1e-10)
    torch.testing.assert_close(V @ dV.T + dV @ V.T, E @ dE.T + dE @ E.T, rtol=0, atol=1e-9)
    torch.testing.assert_close(result.value_slopes[together], torch.ones(2, dtype=torch.float64), rtol=1e-9, atol=0)


@pytest.mark.thorough
def test_more_orders_split_what_two_derivatives_leave_together():
    def matrices(b):
        t = b[0]
        turn = torch.stack([torch.stack([torch.cos(t), -torch.sin(t)]), torch.stack([torch.sin(t), torch.cos(t)])])
        low = turn @ torch.diag(torch.stack([1 + t + t**3, 1 + t - t**3])) @ turn.T
        return torch.block_diag(low, torch.diag(torch.stack([3 + t, 4 - t]))), torch.ones(4, dtype=torch.float64)

    assert eigenpair_branches(matrices, ZERO, ONE, 2).split.tolist() == [UNSPLIT, UNSPLIT]
    result = eigenpair_branches(matrices, ZERO, ONE, 2, orders=4)
    assert result.split.tolist() == [3, 3]
    # lowest of the split ones first: the column that belongs to - t^3 is (0, 1), turning at the rate (-1, 0)
    torch.testing.assert_close(
        result.vectors[:2].abs(), torch.tensor([[0.0, 1.0], [1.0, 0.0]]).double(), rtol=0, atol=1e-10
    )
    rates = result.vector_slopes[:2] * torch.sign(result.vectors[[1, 0], [0, 1]])
    torch.testing.assert_close(rates, torch.tensor([[-1.0, 0.0], [0.0, 1.0]]).double(), rtol=0, atol=1e-9)


def bending(elements: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Hermite beam of unit length, stiffness and mass per length, clamped at one end: K and M [2 elements, ...]."""
    h = 1 / elements
    k = torch.tensor([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]], dtype=torch.float64) / h**3
    k = torch.cat([k, torch.stack([-k[0], k[0] * h - k[1]])])
    k[3] = torch.tensor([6 * h, 2 * h * h, -6 * h, 4 * h * h], dtype=torch.float64) / h**3
    m = torch.tensor(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h * h, 13 * h, -3 * h * h],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h * h, -22 * h, 4 * h * h],
        ],
        dtype=torch.float64,
    ) * (h / 420)
    size = 2 * elements + 2
    K, M = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size, size, dtype=torch.float64)
    for e in range(elements):
        here = slice(2 * e, 2 * e + 4)
        K[here, here] += k
        M[here, here] += m
    return K[2:, 2:], M[2:, 2:]


@pytest.mark.parametrize("variable", [0, 1])
def test_the_square_cantilever_bends_in_its_own_planes(variable):
    # Width b_0 and height b_1, both 1; the axes of the model are turned by 0.3 rad from those of the section, so that
    # no axis is given away. Bending over the height has lambda = b_1^2 / 12 mu, over the width b_0^2 / 12 mu.
    K1, M1 = bending(8)
    c, s = math.cos(0.3), math.sin(0.3)
    turn = torch.kron(torch.tensor([[c, -s], [s, c]], dtype=torch.float64), torch.eye(len(K1), dtype=torch.float64))

    def matrices(b):
        area = b[0] * b[1]
        K = torch.block_diag(area * b[1] ** 2 / 12 * K1, area * b[0] ** 2 / 12 * K1)
        return turn @ K @ turn.T, turn @ torch.block_diag(area * M1, area * M1) @ turn.T

    b = torch.ones(2, dtype=torch.float64)
    direction = torch.eye(2, dtype=torch.float64)[variable]
    result = eigenpair_branches(matrices, b, direction, 4)
    assert result.split.tolist() == [1, 1, 1, 1]
    mu = result.values * 12
    assert mu[0] == pytest.approx(3.5160152685**2, rel=1e-4)  # the clamped-free beam, closed form
    expected = torch.stack([0 * mu[0], mu[0] / 6, 0 * mu[2], mu[2] / 6])
    torch.testing.assert_close(result.value_slopes, expected, rtol=1e-8, atol=1e-8 * mu[2].item() / 6)
    # the shapes stay; the mass makes them shrink at the rate 1/2
    rates = result.vector_slopes + result.vectors / 2
    assert rates.abs().max() < 1e-8 * result.vectors.abs().max()
    in_section = turn.T @ result.vectors
    half = len(K1)
    bends_over_height = torch.linalg.norm(in_section[:half], dim=0) > torch.linalg.norm(in_section[half:], dim=0)
    moves_with_height = torch.tensor([False, True, False, True]) if variable == 1 else torch.tensor([True, False] * 2)
    assert torch.equal(bends_over_height, moves_with_height)
    assert (
        torch.minimum(*(torch.linalg.norm(in_section[part], dim=0) for part in (slice(half), slice(half, None)))).max()
        < 1e-8
    )


def test_bad_input_is_named():
    family = FAMILIES[0]
    with refused("orders", 0):
        branches(family, orders=0)
    with refused("matrices"):
        eigenpair_branches(lambda b: (torch.eye(3).double().expand(2, 3, 3), torch.ones(3).double()), ZERO, ONE, 1)
