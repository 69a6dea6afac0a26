"""The sparse elimination against a dense solution, and how it grows with a chain."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mechanisms import linked
from torchmbd.extensions.native.elimination import SparseElimination, elimination
from torchmbd.extensions.native.mechanism import Mechanism


def solved(e: SparseElimination, K: np.ndarray, b: np.ndarray) -> np.ndarray:
    """As factors.cpp does it, one number after another."""
    n, row, column = len(K), np.nonzero(K)[0], np.nonzero(K)[1]
    memory = np.zeros(e.size)
    memory[e.addresses(row, column)] = K[row, column]
    places = {(int(i), int(j)): k for k, (i, j) in enumerate(zip(e.row, e.column, strict=True))}
    for k in range(n):
        p, later = int(e.order[k]), [int(i) for i in e.later[e.start[k] : e.start[k + 1]]]
        for i in later:
            memory[places[i, p]] /= memory[places[p, p]]
            for j in later:
                memory[places[i, j]] -= memory[places[i, p]] * memory[places[p, j]]
    L, U = np.eye(n), np.zeros((n, n))
    at = {int(p): k for k, p in enumerate(e.order)}
    for (i, j), k in places.items():
        (L if at[i] > at[j] else U)[at[i], at[j]] = memory[k]
    x = np.empty(n)
    x[e.order] = np.linalg.solve(U, np.linalg.solve(L, b[e.order]))
    return x


@pytest.mark.parametrize("seed", range(5))
def test_a_sparse_matrix_is_solved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, first = 17, 11
    K = np.where(rng.random((n, n)) < 0.15, rng.standard_normal((n, n)), 0.0)
    K = K + K.T + 6.0 * np.eye(n)
    row, column = np.nonzero(K)
    e = elimination(n, first, row, column)
    assert sorted(e.order[:first].tolist()) == list(range(first))
    b = rng.standard_normal(n)
    np.testing.assert_allclose(solved(e, K, b), np.linalg.solve(K, b), rtol=1e-10, atol=1e-12)


def test_places_that_are_met_are_those_of_the_later_row() -> None:
    rng = np.random.default_rng(1)
    K = np.where(rng.random((12, 12)) < 0.2, 1.0, 0.0) + np.eye(12)
    e = elimination(12, 8, *np.nonzero(K))
    places = {(int(i), int(j)): k for k, (i, j) in enumerate(zip(e.row, e.column, strict=True))}
    for k in range(12):
        later = e.later[e.start[k] : e.start[k + 1]]
        for r, i in enumerate(later):
            target, behind = int(e.target[e.start[k] + r]), later[r + 1 :]
            side_by_side, scattered = range(target, target + len(behind)), e.scattered[-1 - target :][: len(behind)]
            result = side_by_side if target >= 0 else scattered
            assert [int(x) for x in result] == [places[int(i), int(j)] for j in behind]


@pytest.mark.thorough
def test_numbers_grow_with_the_links() -> None:
    numbers = []
    for links in (6, 12, 24):
        dynamics = linked(links).dynamics()
        numbers.append(Mechanism(dynamics.topology, dynamics.saddle.blocks.rows, True).elimination.size)
    assert numbers[2] - numbers[1] <= 2.1 * (numbers[1] - numbers[0])
