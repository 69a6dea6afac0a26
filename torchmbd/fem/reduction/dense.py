"""Modes of small or dense problems: all of them, by one Cholesky factorization and one symmetric eigenproblem.

With a shift sigma below the lowest eigenvalue, K - sigma M = L L' and C = L^-1 M L^-T = U diag(mu) U',

    lambda_j = sigma + 1/mu_j,     psi_j = L^-T u_j / sqrt(mu_j)        (psi' M psi = 1)

The *inverse* problem is solved because it gives the lowest eigenvalues to full relative accuracy where the
spectrum spans ten orders of magnitude, as plates do; eigh(K, M) would lose them in the rounding of the largest.
The deflated solve of the derivatives, (K - lambda_i M) z = f within the discarded modes j > n, is

    z = L^-T U_d diag(1 / (1 - (lambda_i - sigma) mu_d)) U_d' L^-1 f

in which no small number is divided by a small one: only gaps to discarded modes appear. A lane may retain fewer modes than
others (cut.py): its further vectors are zero.
Works on [lane, ...] tensors, no autograd inside. Checked in tests/fem/reduction and tests/sensitivity.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.fem.reduction.forms import NO_INERTIA, Form, Indefinite, lane_name
from torchmbd.fem.reduction.shift import choose_shift, comparable_shift, loses_digits


class DenseModes:
    """Modes of a batch of problems [lane, N, N], with the factors for deflated solves."""

    complete = True  # all eigenvalues are known

    def __init__(self, K_form: Form, M_form: Form, K: Tensor, M: Tensor, n: int) -> None:
        K_dense, M_dense = K_form.dense(K), M_form.dense(M)

        def factorize(shift: Tensor) -> tuple[Tensor, Tensor]:
            return self._factor(K_dense, M_dense, shift)

        check_positive_definite(M_dense)
        self.n, self.counts = n, torch.full((len(K),), n)
        self.shift, self.L = choose_shift(K_form.diagonal(K), M_form.diagonal(M), factorize)
        self._decompose(M_dense)
        if (near := loses_digits(self.shift, self.mu[:, : n + 1])).any():
            self.shift = comparable_shift(near, self.shift, self.eigenvalues()[:, : n + 1])
            self.L, _ = factorize(self.shift)
            self._decompose(M_dense)

    def _decompose(self, M: Tensor) -> None:
        half = torch.linalg.solve_triangular(self.L, M, upper=False)
        C = torch.linalg.solve_triangular(self.L, half.mT, upper=False)
        mu, U = torch.linalg.eigh((C + C.mT) / 2)
        self.mu, self.U = mu.flip(-1), U.flip(-1)

    def retain(self, counts: Tensor) -> None:
        """Retain so many of the lowest modes of each lane [lane]."""
        self.n, self.counts = int(counts.max()), counts

    def _retained(self) -> Tensor:
        """Which of the modes 1 ... n each lane retains [lane, 1, n]."""
        return (torch.arange(self.n) < self.counts[:, None])[:, None]

    def eigenvalues(self) -> Tensor:
        """All of them [lane, N]."""
        return self.shift[:, None] + 1 / self.mu

    @staticmethod
    def _factor(K: Tensor, M: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        """The factor, and the smallest pivot of each lane relative to the diagonal (<= 0: not positive definite)."""
        shifted = K - shift[:, None, None] * M
        L, info = torch.linalg.cholesky_ex(shifted)
        pivots = L.diagonal(dim1=-2, dim2=-1) ** 2 / shifted.diagonal(dim1=-2, dim2=-1)
        smallest = torch.where(info == 0, pivots.amin(-1), -1.0)
        return L, smallest

    def lowest(self) -> tuple[Tensor, Tensor]:
        """All eigenvalues [lane, N], and the vectors [lane, N, n] of the lowest."""
        n = self.n
        vectors = torch.linalg.solve_triangular(self.L.mT, self.U[..., :n], upper=True) / self.mu[:, None, :n].sqrt()
        return self.eigenvalues(), torch.where(self._retained(), vectors, 0.0)

    def deflated_solve(self, F: Tensor) -> Tensor:
        """Solve (K - lambda_i M) z_i = f_i within the discarded modes; F, Z [lane, N, T, n]."""
        lanes, size, count, n = F.shape
        first = int(self.counts.min())
        U, mu = self.U[..., first:], self.mu[:, first:, None]
        half = U.mT @ torch.linalg.solve_triangular(self.L, F.flatten(2), upper=False)
        pair = self._retained() & (torch.arange(first, size)[:, None] >= self.counts[:, None, None])
        weight = torch.where(pair, 1 / (1 - torch.where(pair, mu / self.mu[:, None, :n], 0.0)), 0.0)
        weighted = half.unflatten(-1, (count, n)) * weight[:, :, None, :]
        Z = torch.linalg.solve_triangular(self.L.mT, U @ weighted.flatten(2), upper=True)
        return Z.reshape(lanes, size, count, n)


def check_positive_definite(M: Tensor) -> None:
    """Raise Indefinite with the lane where the Cholesky factorization of M [lane, N, N] breaks down."""
    info = torch.linalg.cholesky_ex(M).info
    if info.any():
        lane = int(info.nonzero()[0])
        row = int(torch.linalg.eigh(M[lane]).eigenvectors[:, 0].abs().argmax())
        raise Indefinite("M", lane_name(lane, len(M)), NO_INERTIA, row)
