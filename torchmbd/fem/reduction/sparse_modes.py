"""Modes of large sparse problems, and their deflated solves, from one factorization.

With a shift sigma below the spectrum and M = G G', the operator

    H = G' (K - sigma M)^-1 G,      H u_j = mu_j u_j,      mu_j = 1 / (lambda_j - sigma),      psi_j = G'^-1 u_j

is symmetric, and block Lanczos finds its largest mu. The deflated solve (K - lambda_i M) z = f becomes, with z =
G'^-1 y,

    (1 - H / mu_i) y = c,      c = G' (K - sigma M)^-1 f,      y and c orthogonal to the retained u

Its eigenvalues 1 - mu_j / mu_i lie in (0, 1] for the discarded modes j > n and crowd at 1: conjugate gradients
converge in a few steps. They start from the solution in the discarded modes whose Ritz pairs have nearly converged.
A lane may retain fewer modes than others (cut.py): its further vectors are zero.
All directions and all modes are columns of the same products with the same H.
Works on [lane, ...] tensors, no autograd inside. Checked in tests/fem/reduction/test_sparse_modes.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.errors import SimulationFailure
from torchmbd.fem.reduction.blocks import BlockFactor, DiagonalRoot
from torchmbd.fem.reduction.elimination import Factor, factorize, layout, root
from torchmbd.fem.reduction.forms import Form
from torchmbd.fem.reduction.lanczos import Recurrence, Ritz, lanczos
from torchmbd.fem.reduction.shift import choose_shift, comparable_shift, loses_digits
from torchmbd.math.products import Factor as CompiledFactor
from torchmbd.math.products import Products, compiled_products

TOLERANCE = 1e-12  # of the modes, relative to mu
DERIVATIVE_TOLERANCE = 5e-12  # of their derivatives, relative to c
KNOWN = 1e-2  # largest residual of discarded Ritz pairs in which conjugate gradients start from the solution

MOST_STEPS = 300
NO_CONVERGENCE = f"derivatives of modes did not converge in {MOST_STEPS} steps; is K nearly singular?"


class SparseModes:
    """Modes of a batch of problems on one pattern. `exhausted` when the Krylov space grew too large: use DenseModes."""

    complete = False  # some eigenvalues are known

    def __init__(self, K_form: Form, M_form: Form, K: Tensor, M: Tensor, n: int) -> None:
        self.layout = layout(K_form, M_form)
        self.root = root(self.layout, M_form, M)
        self._matrices, self._start = (K_form, K, M_form, M), (len(K), len(self.layout.order))
        self.shift, self.factor = choose_shift(K_form.diagonal(K), M_form.diagonal(M), self._factorized)
        ritz = self._iterate(self._start, n, 1e-3 if self.shift.any() else TOLERANCE)
        self._take(ritz, n, self.shift)

    def _factorized(self, shift: Tensor) -> tuple[Factor, Tensor]:
        """The factor of K - shift M, and its smallest pivots [lane]."""
        factor = factorize(self.layout, *self._matrices, shift)
        return factor, factor.pivot

    def more(self, n: int) -> None:
        """Solve for more modes: the iteration continues."""
        self._take(self._iterate(self._recurrence, n, TOLERANCE), n, torch.zeros_like(self.shift))

    def _take(self, ritz: Ritz | None, n: int, first_shift: Tensor) -> None:
        """Retain n modes, solved for once more where a shift is too near the spectrum; first_shift: 0 if it was replaced."""
        if ritz is not None and (near := loses_digits(first_shift, ritz.mu[:, : n + 1])).any():
            self.shift = comparable_shift(near, self.shift, self.shift[:, None] + 1 / ritz.mu[:, : n + 1])
            self.factor, _ = self._factorized(self.shift)
            ritz = self._iterate(self._start, n, TOLERANCE)
        self.exhausted = ritz is None
        if ritz is not None:
            known = int((ritz.residuals() < KNOWN).sum(1).min())
            self.ritz, self._vectors = ritz, ritz.Q @ ritz.V[..., : max(known, n + 1)]
            self.retain(torch.full((len(ritz.mu),), n))

    def retain(self, counts: Tensor) -> None:
        """Retain so many of the lowest modes of each lane [lane], at most as many as were solved for."""
        n, first, U = int(counts.max()), int(counts.min()), self._vectors
        self.n, self.first, self.counts = n, first, counts
        retained = (torch.arange(U.shape[2]) < counts[:, None])[:, None]
        self.retained, self.discarded = retained[..., :n], ~retained[..., first:]
        self.U, self.known = U[..., :n], U[..., first:]
        if first < n:
            self.U, self.known = torch.where(self.retained, self.U, 0.0), torch.where(self.discarded, self.known, 0.0)

    def _iterate(self, start: tuple[int, int] | Recurrence, n: int, tolerance: float) -> Ritz | None:
        extend = None if self._compiled(self.shift) is None else self._extend
        ritz, self._recurrence = lanczos(self._apply, start, n, tolerance, extend)
        return ritz

    def _extend(self, recurrence: Recurrence, steps: int) -> None:
        """Extend as `Recurrence.extend`, by compiled code."""
        compiled = self._compiled(recurrence.X)
        assert compiled is not None
        code, factor, G = compiled
        state = recurrence.Q, recurrence.T, recurrence.X, recurrence.R
        code.lanczos(factor, G, recurrence.steps, steps, *state)
        recurrence.steps = steps

    def _compiled(self, like: Tensor) -> tuple[Products, CompiledFactor, Tensor] | None:
        """Compiled products, and the factor by blocks and diagonal root that they take; None where one is missing."""
        if isinstance(self.root, DiagonalRoot) and isinstance(self.factor, BlockFactor):
            code = compiled_products(like)
            return None if code is None else (code, self.factor.compiled, self.root.G)
        return None

    def _apply(self, X: Tensor) -> Tensor:
        return self.root.upper(self.factor.solve(self.root.lower(X)))

    def eigenvalues(self) -> Tensor:
        """The lowest eigenvalues [lane, more than were solved for], those after the next one roughly."""
        return self.shift[:, None] + 1 / self.ritz.mu[:, : self._vectors.shape[2]]

    def lowest(self) -> tuple[Tensor, Tensor]:
        """Eigenvalues, and the vectors [lane, N, n] of the lowest."""
        return self.eigenvalues(), self.root.upper_inverse(self.U)[:, self.layout.inverse]

    def deflated_solve(self, F: Tensor) -> Tensor:
        """Solve (K - lambda_i M) z_i = f_i within the discarded modes; F, Z [lane, N, T, n]."""
        columns = F[:, self.layout.order].flatten(2)
        inverse_mu = (1 / self.ritz.mu[:, None, : self.n]).repeat(1, 1, F.shape[2])
        if self.first < self.n:
            retained = self.retained.repeat(1, 1, F.shape[2])
            inverse_mu, columns = torch.where(retained, inverse_mu, 0.0), torch.where(retained, columns, 0.0)
        # A solve multiplies rounding in the lowest mode by mu_1 / mu_j: a payload makes that 1e6 and more.
        columns = torch.baddbmm(
            columns, self.root.lower(self.U), self.root.upper_inverse(self.U).mT @ columns, alpha=-1
        )
        c = self.root.upper(self.factor.solve(columns))
        known = c.isfinite().all(1)
        Y = self._conjugate_gradients(c, inverse_mu)
        if not Y.isfinite().all(1)[known].all():
            raise SimulationFailure(NO_CONVERGENCE)
        return self.root.upper_inverse(Y)[:, self.layout.inverse].unflatten(2, F.shape[2:])

    def _discard(self, X: Tensor) -> Tensor:
        """Remove the components along the retained modes in place."""
        return X.baddbmm_(self.U, self.U.mT @ X, alpha=-1)

    def _known_solution(self, c: Tensor, inverse_mu: Tensor) -> tuple[Tensor, Tensor]:
        """Return the Galerkin solution in the discarded modes whose Ritz pairs are known, and its residual."""
        ritz, W, p = self.ritz, self.known, self.ritz.R.shape[-1]
        here = slice(self.first, self.first + W.shape[2])
        inside = W.mT @ c
        solution = inside / (1 - torch.where(self.discarded.mT, inverse_mu * ritz.mu[:, here, None], 0.0))
        residual = torch.baddbmm(c, W, inside, alpha=-1)
        residual.addcmul_(inverse_mu, ritz.X @ (ritz.R @ (ritz.V[:, -p:, here] @ solution)))
        return W @ solution, self._discard(residual)  # else its part in the retained modes stays to the last step

    def _conjugate_gradients(self, c: Tensor, inverse_mu: Tensor) -> Tensor:
        rounding = 4 * torch.finfo(c.dtype).eps * torch.linalg.vector_norm(c, dim=1, keepdim=True)
        c = self._discard(self._discard(c))  # twice, for columns that are nearly all retained modes
        target = DERIVATIVE_TOLERANCE * torch.linalg.vector_norm(c, dim=1, keepdim=True) + rounding
        y, r = self._known_solution(c, inverse_mu)
        if (blocks := self._compiled(y)) is not None:
            code, factor, G = blocks
            shape = (len(y), 1, y.shape[2])
            limits = inverse_mu.expand(shape), target.expand(shape)
            if not code.conjugate_gradients(factor, G, self.U, *limits, y, r, MOST_STEPS):
                raise SimulationFailure(NO_CONVERGENCE)
            return self._discard(y)
        tiny = torch.finfo(y.dtype).tiny
        result, columns = torch.empty_like(y), torch.arange(y.shape[2])
        d, square = r.clone(), (r * r).sum(1, keepdim=True)
        for _ in range(MOST_STEPS):
            open_ = (square.sqrt() > target).any(0)[0].nonzero().squeeze(-1)
            if len(open_) <= 0.75 * len(columns):  # drop the columns that have converged in all lanes
                result[:, :, columns] = y
                columns = columns[open_]
                y, r, d, square, target, inverse_mu = (v[..., open_] for v in (y, r, d, square, target, inverse_mu))
            if len(columns) == 0:
                return self._discard(result)
            Hd = self._discard(torch.addcmul(d, inverse_mu, self._apply(d), value=-1))
            step = square / (d * Hd).sum(1, keepdim=True).clamp_min(tiny)
            step = torch.where(square.sqrt() > target, step, 0.0)  # of converged columns it would be that of rounding
            y.addcmul_(step, d)
            r.addcmul_(step, Hd, value=-1)
            before, square = square, (r * r).sum(1, keepdim=True)
            d.mul_(square / before.clamp_min(tiny)).add_(r)
        raise SimulationFailure(NO_CONVERGENCE)
