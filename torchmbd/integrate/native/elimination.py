"""Tables of the sparse factorization of a saddle-point matrix: rates before constraints, each by least degree.

    order    unknown of each pivot
    beside   later unknowns that a pivot meets, pivot after pivot; near: their pivots
    memory   of each pivot [pivot][its row][its column]; row and column where it meets others, as `beside`

So storage and work are linear in the bodies of chains and trees.
Source: George and Liu, Computer Solution of Large Sparse Positive Definite Systems, Prentice-Hall 1981, chapter 5.
Checked in tests/integrate/native/test_elimination.py: against a dense solution.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.intc]


@dataclass(frozen=True)
class Elimination:
    """See the module header; as `Mechanism` in factors.cpp."""

    numbers: int
    order: Integers
    start: Integers
    beside: Integers
    near: Integers
    base: Integers
    head: Integers
    places: Integers
    row: Integers
    column: Integers
    _keys: NDArray[np.int64]
    _at: NDArray[np.int64]
    _pivot: NDArray[np.int64]

    def place(self, row: NDArray[np.int64], column: NDArray[np.int64]) -> Integers:
        """Where entries of the matrix stand in memory."""
        keys = self._pivot[row] * len(self.order) + self._pivot[column]
        return self._at[np.searchsorted(self._keys, keys)].astype(np.intc)


def elimination(n: int, first: int, row: NDArray[np.int64], column: NDArray[np.int64]) -> Elimination:
    """Of a matrix of n unknowns with entries at (row, column), or their mirror images: the `first` unknowns come first."""
    order, meets = _order(n, first, row, column)
    pivot = np.empty(n, dtype=np.int64)
    pivot[order] = np.arange(n)
    near = [np.sort(pivot[np.array(sorted(m), dtype=np.int64)]) for m in meets]
    count = np.array([len(x) for x in near], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(count)])
    base = np.concatenate([[0], np.cumsum(1 + 2 * count)])
    head, places = _heads(near, base)
    flat = np.concatenate([*near, np.empty(0, dtype=np.int64)]).astype(np.int64)
    own = np.repeat(np.arange(n), count)
    within = np.arange(len(flat)) - np.repeat(start[:-1], count)
    upper = base[:-1][own] + 1 + within
    lower = upper + count[own]
    order_array = np.array(order, dtype=np.int64)
    r = np.empty(base[-1], dtype=np.intc)
    c = np.empty(base[-1], dtype=np.intc)
    for places_of, i, j in ((base[:-1], np.arange(n), np.arange(n)), (upper, own, flat), (lower, flat, own)):
        r[places_of], c[places_of] = order_array[i], order_array[j]
    keys = np.concatenate([np.arange(n) * (n + 1), own * n + flat, flat * n + own])
    at = np.concatenate([base[:-1], upper, lower])
    sorting = np.argsort(keys)

    def integers(x: NDArray) -> Integers:
        return np.ascontiguousarray(x, dtype=np.intc)

    return Elimination(
        int(base[-1]),
        integers(order_array),
        integers(start),
        integers(order_array[flat]),
        integers(flat),
        integers(base),
        integers(np.array(head)),
        integers(np.array(places)),
        r,
        c,
        keys[sorting],
        at[sorting],
        pivot,
    )


def _order(n: int, first: int, row: NDArray[np.int64], column: NDArray[np.int64]) -> tuple[list[int], list[set[int]]]:
    """Unknowns in the order of elimination, and those that each then meets."""
    meets: list[set[int]] = [set() for _ in range(n)]
    for i, j in zip(row.tolist(), column.tolist(), strict=True):
        if i != j:
            meets[i].add(j)
            meets[j].add(i)
    order, found = [], []
    for some in (range(first), range(first, n)):
        heap = [(len(meets[i]), i) for i in some]
        heapq.heapify(heap)
        done: set[int] = set()
        while heap:
            degree, p = heapq.heappop(heap)
            if p in done or degree != len(meets[p]):
                continue
            done.add(p)
            order.append(p)
            beside = meets[p]
            found.append(beside)
            for i in beside:
                own = meets[i]
                own |= beside
                own.discard(i)
                own.discard(p)
                if i in some:
                    heapq.heappush(heap, (len(own), i))
    return order, found


def _heads(near: list[NDArray[np.int64]], base: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Of each entry of a row: where its row meets the entries after it, as in factors.cpp."""
    head: list[int] = []
    places: list[int] = []
    for some in near:
        for r, i in enumerate(some.tolist()):
            later = some[r + 1 :]
            at = base[i] + 1 + np.searchsorted(near[i], later)
            if not len(later):
                head.append(0)
            elif at[-1] - at[0] == len(at) - 1:
                head.append(int(at[0]))
            else:
                head.append(-1 - len(places))
                places += at.tolist()
    return head, places
