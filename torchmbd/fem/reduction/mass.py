"""Coordinates in which the mass matrix is the identity: M = G G', y = G' x.

A diagonal M has G = sqrt(M). A sparse one shares the block-tridiagonal partition of K, and G is block-bidiagonal.
Tensors are [lane, N, columns] in the order of the partition. No autograd inside.
Checked in tests/fem/reduction/test_sparse_modes.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.blocks import storage, views
from torchmbd.fem.reduction.forms import Diagonal, Form, lane_name
from torchmbd.fem.reduction.partition import Partition


class DiagonalRoot:
    """G of a diagonal mass [lane, N]."""

    def __init__(self, layout: Partition, values: Tensor) -> None:
        self.G = values[:, layout.order].sqrt()[:, :, None]

    def lower(self, X: Tensor) -> Tensor:
        return self.G * X

    def upper(self, X: Tensor) -> Tensor:
        return self.G * X

    def upper_inverse(self, X: Tensor) -> Tensor:
        return X / self.G


class BlockRoot:
    """G of a block-tridiagonal mass: L_i on the diagonal, C_i below it."""

    def __init__(self, layout: Partition, flat: Tensor) -> None:
        D, B = views(layout, flat)
        self.bounds = layout.bounds
        self.L: list[Tensor] = []
        self.C: list[Tensor] = []
        for i, block in enumerate(D):
            S = block if i == 0 else torch.baddbmm(block, self.C[-1], self.C[-1].mT, alpha=-1)
            L, info = torch.linalg.cholesky_ex(S)
            if info.any():
                lane = int(info.nonzero()[0])
                row = int(layout.order[layout.bounds[i] + int(info[lane]) - 1])
                raise InputError(
                    f"M{lane_name(lane, len(flat))} is not positive definite: "
                    f"elimination leaves no positive number in row {row}"
                )
            self.L.append(L)
            if i + 1 < len(D):
                self.C.append(torch.linalg.solve_triangular(L, B[i].mT, upper=False).mT)

    def _parts(self, X: Tensor) -> list[Tensor]:
        return [X[:, start:end] for start, end in zip(self.bounds, self.bounds[1:], strict=False)]

    def lower(self, X: Tensor) -> Tensor:
        """G X."""
        parts = self._parts(X)
        rows = [L @ x for L, x in zip(self.L, parts, strict=True)]
        return torch.cat(rows[:1] + [r + C @ x for r, C, x in zip(rows[1:], self.C, parts, strict=False)], 1)

    def upper(self, X: Tensor) -> Tensor:
        """G' X."""
        parts = self._parts(X)
        rows = [L.mT @ x for L, x in zip(self.L, parts, strict=True)]
        coupled = [r + C.mT @ x for r, C, x in zip(rows, self.C, parts[1:], strict=False)]
        return torch.cat(coupled + rows[-1:], 1)

    def upper_inverse(self, X: Tensor) -> Tensor:
        """G'^-1 X."""
        parts, rows = self._parts(X), []
        for i in range(len(parts) - 1, -1, -1):
            right = parts[i] if not rows else parts[i] - self.C[i].mT @ rows[-1]
            rows.append(torch.linalg.solve_triangular(self.L[i].mT, right, upper=True))
        return torch.cat(rows[::-1], 1)


def mass_root(layout: Partition, form: Form, values: Tensor) -> DiagonalRoot | BlockRoot:
    """Factorize M. Raises InputError where it is not positive definite."""
    if isinstance(form, Diagonal):
        return DiagonalRoot(layout, values)
    return BlockRoot(layout, storage(layout, form, values))
