"""Static displacements U = K^-1 F of the free freedoms under columns of loads, differentiable in K and in F.

    | K  -F |
    | -F' 1 |      its constraint modes of the last rows (constraint_modes.py) are K^-1 F

so factorization and derivatives, forward and reverse, are those of constraint modes; the columns are amounts of loads.
Checked in tests/multibody/statics/test_buckling.py.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.constraint_modes import constraint_modes
from torchmbd.math.sparse import Pattern, SparseMatrix


class StaticLoads:
    """Solves for `columns` loads of all matrices of one pattern."""

    def __init__(self, pattern: Pattern, columns: int) -> None:
        n, k = pattern.size, columns
        free, load = torch.arange(n).repeat_interleave(k), n + torch.arange(k).repeat(n)
        own = n + torch.arange(k)
        rows, cols = torch.cat([pattern.rows, free, load, own]), torch.cat([pattern.cols, load, free, own])
        self.pattern, self._position = Pattern.gather(rows, cols, n + k)
        self.loads = tuple(range(n, n + k))
        self._one = torch.ones(n + k, dtype=torch.float64)

    def __call__(self, K: SparseMatrix, F: Float[Tensor, "*lanes N k"]) -> Float[Tensor, "*lanes N k"]:
        """K^-1 F. Raises InputError where K is not positive definite."""
        n, k = F.shape[-2:]
        lanes = np.broadcast_shapes(K.values.shape[:-1], F.shape[:-2])
        flat = F.expand(*lanes, n, k).flatten(-2)
        numbers = torch.cat([K.values.expand(*lanes, -1), -flat, -flat, F.new_ones(*lanes, k)], -1)
        values = numbers.new_zeros(*lanes, self.pattern.nnz).index_copy(-1, self._position, numbers)
        try:
            modes, _ = constraint_modes(SparseMatrix(self.pattern, values, symmetric=True), self._one, self.loads)
        except InputError as error:
            raise InputError(f"static loads: {error}") from None
        return modes[..., :n, :]
