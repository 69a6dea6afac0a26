"""Static displacements U = K^-1 F of the free degrees of freedom under columns of loads, differentiable in K and in F.

    dU = K^-1 (dF - dK U)                                             forward
    for a cotangent G of U:   Y = K^-1 G,   <G, dU> = <Y, dF> - <Y U', dK>      reverse

One factorization serves all columns, values and derivatives.
Checked in tests/extensions/buckling/test_buckling.py.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.reduction.elimination import Solver, layout
from torchmbd.fem.reduction.forms import Diagonal, Sparse, check
from torchmbd.fem.reduction.operator_call import StaticDerivative
from torchmbd.math.sparse import Pattern, SparseMatrix
from torchmbd.math.vmap import apply_as_lanes


class StaticLoads:
    """Static solutions for all stiffness matrices of one pattern."""

    def __init__(self, pattern: Pattern) -> None:
        self.form = Sparse(pattern, symmetric=True)
        # Here, for a transform of torch.func hides its numbers.
        self.layout = layout(self.form, Diagonal(pattern.size))

    def __call__(self, K: SparseMatrix, F: Float[Tensor, "*lanes N k"]) -> Float[Tensor, "*lanes N k"]:
        """K^-1 F. Raises InputError if K is not positive definite."""
        lanes = np.broadcast_shapes(K.values.shape[:-1], F.shape[:-2])
        values = K.values.expand(*lanes, -1).reshape(-1, K.pattern.nnz)
        columns = F.expand(*lanes, *F.shape[-2:]).reshape(-1, *F.shape[-2:])
        displacements: Any = _Displacements.apply(Solver(self.form, self.layout), values, columns)
        return displacements.reshape(*lanes, *F.shape[-2:])


class _Displacements(torch.autograd.Function):
    """U [lane, N, k] of K [lane, nnz] and F [lane, N, k]."""

    @staticmethod
    def forward(solver: Solver, K: Tensor, F: Tensor) -> Tensor:
        check("K", solver.form, K)
        solver.factorize(K, "of static loads lets something move")
        return solver.solve(F[:, None])[:, 0].contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.solver = inputs[0]
        ctx.save_for_forward(output)
        ctx.save_for_backward(output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, solver: Solver, K: Tensor, F: Tensor) -> tuple[Tensor, int]:
        return apply_as_lanes(partial(_Displacements.apply, solver), info, in_dims[1:], K, F)

    @staticmethod
    def jvp(ctx: Any, _solver: None, dK: Tensor | None, dF: Tensor | None) -> Any:
        (U,) = ctx.saved_tensors
        dK, dF = (None if x is None else x.unsqueeze(1) for x in (dK, dF))
        tangent: Any = StaticDerivative.apply(partial(_tangent, ctx.solver), 1, U, dK, dF)
        return tangent[0].squeeze(1)

    @staticmethod
    def backward(ctx: Any, *G: Tensor) -> tuple[None, Tensor, Tensor]:
        (U,) = ctx.saved_tensors
        bars: Any = StaticDerivative.apply(partial(_cotangent, ctx.solver), 1, U, G[0].unsqueeze(1))
        return None, *(bar.squeeze(1) for bar in bars)


def _tangent(solver: Solver, U: Tensor, dK: Tensor | None, dF: Tensor | None) -> tuple[Tensor, Tensor]:
    """dU [lane, T, N, k] of dK [lane, T, nnz] and dF [lane, T, N, k], and nothing."""
    loads = 0.0 if dK is None else solver.form.multiply(dK, U[:, None])
    total = -loads if dF is None else dF - loads
    assert isinstance(total, Tensor)
    return solver.solve(total).contiguous(), U.new_zeros(*total.shape[:2], 0)


def _cotangent(solver: Solver, U: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
    """The cotangents of K [lane, T, nnz] and of F [lane, T, N, k] from that of U [lane, T, N, k]."""
    Y = solver.solve(G).contiguous()
    return -solver.form.pair(Y, U[:, None]), Y
