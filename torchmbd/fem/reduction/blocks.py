"""Factorization of block-tridiagonal matrices, for a batch of designs and many right-hand sides at once.

    A = | D_0  B_1'          |        S_0 = D_0,   E_i = B_i S_(i-1)^-1,   S_i = D_i - E_i B_i'
        | B_1  D_1  B_2'     |
        |      B_2  D_2  ... |        y_i = r_i - E_i y_(i-1),     x_i = S_i^-1 y_i - E_(i+1)' x_(i+1)

The inverses of the S_i are formed: a solve is then three matrix products for each block and nothing else, which runs
at the speed of matrix products over all lanes. For positive definite A the forward error is that of a banded
Cholesky factorization (both are bounded by the condition of A; measured on plates, they are equal).
Roots of the mass give coordinates in which it is the identity: M = G G', y = G' x. A diagonal M has G = sqrt(M). A sparse
one shares the block-tridiagonal partition of K, and G is block-bidiagonal.
Tensors are [lane, N, columns] in the order of the partition. No autograd inside.
Checked in tests/fem/reduction/test_sparse_modes.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.fem.reduction.forms import Diagonal, Form, IndefiniteLane
from torchmbd.fem.reduction.partition import Partition, form_sums
from torchmbd.math.products import Factor, compiled_products

SMALL = 64  # largest number of rows of blocks that compiled code eliminates; LAPACK is faster for larger ones


def storage(layout: Partition, form: Form, values: Tensor) -> Tensor:
    """Put the values [lane, *entry] of a matrix into block storage [lane, :]: D_0, D_1, ..., B_1, B_2, ..."""
    return form_sums(layout, form)(values.flatten(1))


def views(layout: Partition, flat: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """The diagonal blocks D_i [lane, s_i, s_i] and the lower blocks B_i [lane, s_i, s_(i-1)] of a storage."""
    sizes = layout.sizes
    shapes = [(s, s) for s in sizes] + list(zip(sizes[1:], sizes, strict=False))
    parts = flat.split([r * c for r, c in shapes], dim=1)
    blocks = [part.view(len(flat), *shape) for part, shape in zip(parts, shapes, strict=True)]
    return blocks[: len(sizes)], blocks[len(sizes) :]


class BlockFactor:
    """S_i^-1 and E_i of a symmetric positive definite matrix.

    pivot  smallest pivot of each lane relative to its diagonal entry; <= 0 where the matrix is not positive definite

    flat: storage of the matrix, which is overwritten
    """

    def __init__(self, layout: Partition, flat: Tensor) -> None:
        self.bounds = layout.bounds
        self.S_inverse, self.E = views(layout, flat)
        self.compiled = Factor(layout.bounds, flat)
        if max(layout.sizes) <= SMALL and (code := compiled_products(flat)) is not None:
            self.pivot = code.factorize(self.compiled)
        else:
            self.pivot = torch.stack([self._eliminate(i) for i in range(len(self.S_inverse))]).amin(0)

    def _eliminate(self, i: int) -> Tensor:
        """Eliminate block i; return its smallest pivot relative to the diagonal."""
        D = self.S_inverse[i]
        S = torch.baddbmm(D, self.E[i - 1], self._before.mT, alpha=-1) if i else D
        L, info = torch.linalg.cholesky_ex(S)
        smallest = (L.diagonal(dim1=-2, dim2=-1) ** 2 / D.diagonal(dim1=-2, dim2=-1)).amin(-1)
        if info.any():  # a lane that cannot be factorized must not stop the others; its `pivot` is negative
            L = torch.where((info == 0)[:, None, None], L, torch.eye(L.shape[-1], dtype=L.dtype))
        D.copy_(torch.cholesky_inverse(L))
        if i < len(self.E):
            self._before = self.E[i].clone()
            torch.bmm(self._before, D, out=self.E[i])
        return torch.where(info == 0, smallest, -1.0)

    def solve(self, X: Tensor) -> Tensor:
        """A^-1 X for columns [lane, N, k]."""
        if (code := compiled_products(X)) is not None:
            return code.solve(self.compiled, X)
        parts = [X[:, start:end] for start, end in zip(self.bounds, self.bounds[1:], strict=False)]
        forward = [parts[0]]
        for part, E in zip(parts[1:], self.E, strict=True):
            forward.append(torch.baddbmm(part, E, forward[-1], alpha=-1))
        solution = torch.empty_like(X)
        x = torch.bmm(self.S_inverse[-1], forward[-1])
        solution[:, self.bounds[-2] :] = x
        for i in range(len(self.E) - 1, -1, -1):
            x = torch.bmm(self.S_inverse[i], forward[i]).baddbmm_(self.E[i].mT, x, alpha=-1)
            solution[:, self.bounds[i] : self.bounds[i + 1]] = x
        return solution


class DiagonalRoot:
    """G of a diagonal mass [lane, N]."""

    def __init__(self, order: Tensor, values: Tensor) -> None:
        self.G = values[:, order].sqrt()[:, :, None]

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
                raise IndefiniteLane(int(info.nonzero()[0]))
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
    """Factorize M. Raises IndefiniteLane where it is not positive definite."""
    if isinstance(form, Diagonal):
        return DiagonalRoot(layout.order, values)
    return BlockRoot(layout, storage(layout, form, values))
