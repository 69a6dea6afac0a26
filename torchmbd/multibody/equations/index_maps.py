"""Constant linear maps by index tables: sums of columns by groups, and matrices with few entries in a row.

Sums are gathers from a padded table: one gather and one sum whatever the number of joints, and no atomic additions.
Checked in tests/multibody/equations/test_equations.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchmbd.math.pair import cat, linear
from torchmbd.math.row_selection import select_rows


class SegmentSum:
    """Sums of columns by groups: [k, n, ...] -> [k, groups, ...]; group: of each column, -1: of none."""

    def __init__(self, group: Sequence[int], groups: int):
        members: list[list[int]] = [[] for _ in range(groups)]
        for column, g in enumerate(group):
            if g >= 0:
                members[g].append(column)
        width = max((len(m) for m in members), default=0)
        padding = len(group)  # an extra column of zeros
        self.groups, self.width = groups, width
        table: list[list[int]] = [m + [padding] * (width - len(m)) for m in members]
        self.table = torch.tensor([m[k] for k in range(width) for m in table], dtype=torch.long)
        self.padded = any(padding in m for m in table)

    def __call__(self, *parts):
        """Sum the columns of all parts, concatenated."""
        if self.width == 0:
            return linear(lambda y: y.new_zeros(y.shape[0], self.groups, *y.shape[2:]), parts[0])
        columns = list(parts)
        if self.padded:
            columns.append(linear(lambda y: torch.zeros_like(y[:, :1]), columns[0]))
        x = cat(columns, 1) if len(columns) > 1 else columns[0]
        x = x.index_select(1, self.table)
        return x if self.width == 1 else x.unflatten(1, (self.width, self.groups)).sum(1)


class SparseMap:
    """A constant matrix [m, k] with few entries in a row: y = matrix x of tensors or pairs x [k, ...], by one gather.

    x may also be a tensor [times, k, pair, lanes] with `axis` 1.
    """

    def __init__(self, matrix: Tensor):
        entries = [[(j, float(c)) for j, c in enumerate(row) if c != 0.0] for row in matrix.tolist()]
        self.rows, self.width = len(entries), max((len(e) for e in entries), default=0)
        padded = [e + [(0, 0.0)] * (self.width - len(e)) for e in entries]
        self.table = torch.tensor([e[k][0] for k in range(self.width) for e in padded], dtype=torch.long)
        factors = torch.tensor([e[k][1] for k in range(self.width) for e in padded], dtype=torch.float64)
        self.factors = None if bool((factors == 1.0).all()) else factors[:, None, None]
        self.matrix = matrix

    def select_rows(self, rows: list[int]) -> SparseMap:
        """The map of some rows of the matrix."""
        return SparseMap(self.matrix[rows])

    def __call__(self, x, axis: int = 0):
        y = select_rows(x, self.table) if axis else x.index_select(0, self.table)
        y = y if self.factors is None else y * self.factors
        return y if self.width == 1 else y.unflatten(axis, (self.width, self.rows)).sum(axis)
