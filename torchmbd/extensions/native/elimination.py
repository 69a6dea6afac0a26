"""Tables of the sparse factorization of a saddle-point matrix: rates before constraints, each by least degree.

    order          unknown of each pivot
    later          unknowns of later pivots that a pivot meets, pivot after pivot from `start` on; later_pivots: these pivots
    memory         numbers of each pivot from `base` on: its own, its row at `later`, its column at `later`
    row, column    unknowns of each number in memory
    target         of each entry of `later`: where the row of that unknown meets the entries behind it in memory, or -1 - where
                   these addresses begin in `scattered`, if they are not side by side

So storage and work are linear in the bodies of chains and trees.
Source: George and Liu, Computer Solution of Large Sparse Positive Definite Systems, Prentice-Hall 1981, chapter 5.
Checked in tests/extensions/native/test_elimination.py: against a dense solution.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.intc]


@dataclass(frozen=True)
class SparseElimination:
    """See the module header; as `Mechanism` in factors.cpp. size: numbers in memory."""

    size: int
    order: Integers
    start: Integers
    later: Integers
    later_pivots: Integers
    base: Integers
    target: Integers
    scattered: Integers
    row: Integers
    column: Integers
    _keys: NDArray[np.int64]
    _addresses: NDArray[np.int64]
    _pivot: NDArray[np.int64]

    def addresses(self, row: NDArray[np.int64], column: NDArray[np.int64]) -> Integers:
        """Where entries of the matrix are in memory."""
        keys = self._pivot[row] * len(self.order) + self._pivot[column]
        return self._addresses[np.searchsorted(self._keys, keys)].astype(np.intc)


def elimination(n: int, first: int, row: NDArray[np.int64], column: NDArray[np.int64]) -> SparseElimination:
    """Of a matrix of n unknowns with entries at (row, column), or their mirror images: the `first` unknowns come first."""
    order, neighbors = _order(n, first, row, column)
    pivot = np.empty(n, dtype=np.int64)
    pivot[order] = np.arange(n)
    later = [np.sort(pivot[np.array(sorted(m), dtype=np.int64)]) for m in neighbors]
    count = np.array([len(x) for x in later], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(count)])
    base = np.concatenate([[0], np.cumsum(1 + 2 * count)])
    target, scattered = _targets(later, base)
    flat = np.concatenate([*later, np.empty(0, dtype=np.int64)]).astype(np.int64)
    step = np.repeat(np.arange(n), count)
    within = np.arange(len(flat)) - np.repeat(start[:-1], count)
    upper = base[:-1][step] + 1 + within
    lower = upper + count[step]
    order_array = np.array(order, dtype=np.int64)
    r = np.empty(base[-1], dtype=np.intc)
    c = np.empty(base[-1], dtype=np.intc)
    for address, i, j in ((base[:-1], np.arange(n), np.arange(n)), (upper, step, flat), (lower, flat, step)):
        r[address], c[address] = order_array[i], order_array[j]
    keys = np.concatenate([np.arange(n) * (n + 1), step * n + flat, flat * n + step])
    addresses = np.concatenate([base[:-1], upper, lower])
    sorting = np.argsort(keys)

    def integers(x: NDArray) -> Integers:
        return np.ascontiguousarray(x, dtype=np.intc)

    return SparseElimination(
        int(base[-1]),
        integers(order_array),
        integers(start),
        integers(order_array[flat]),
        integers(flat),
        integers(base),
        integers(np.array(target)),
        integers(np.array(scattered)),
        r,
        c,
        keys[sorting],
        addresses[sorting],
        pivot,
    )


def _order(n: int, first: int, row: NDArray[np.int64], column: NDArray[np.int64]) -> tuple[list[int], list[set[int]]]:
    """Unknowns in the order of elimination, and the later unknowns that each then meets."""
    neighbors: list[set[int]] = [set() for _ in range(n)]
    for i, j in zip(row.tolist(), column.tolist(), strict=True):
        if i != j:
            neighbors[i].add(j)
            neighbors[j].add(i)
    order, later = [], []
    for group in (range(first), range(first, n)):
        heap = [(len(neighbors[i]), i) for i in group]
        heapq.heapify(heap)
        done: set[int] = set()
        while heap:
            degree, p = heapq.heappop(heap)
            if p in done or degree != len(neighbors[p]):
                continue
            done.add(p)
            order.append(p)
            later.append(neighbors[p])
            for i in neighbors[p]:
                neighbors[i] |= neighbors[p]
                neighbors[i].discard(i)
                neighbors[i].discard(p)
                if i in group:
                    heapq.heappush(heap, (len(neighbors[i]), i))
    return order, later


def _targets(later: list[NDArray[np.int64]], base: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """`target` and `scattered` of the module header."""
    target: list[int] = []
    scattered: list[int] = []
    for pivots in later:
        for r, i in enumerate(pivots.tolist()):
            behind = pivots[r + 1 :]
            addresses = base[i] + 1 + np.searchsorted(later[i], behind)
            if not len(behind):
                target.append(0)
            elif addresses[-1] - addresses[0] == len(addresses) - 1:
                target.append(int(addresses[0]))
            else:
                target.append(-1 - len(scattered))
                scattered += addresses.tolist()
    return target, scattered
