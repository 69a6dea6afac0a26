"""Static displacements U = K^-1 F of the free freedoms under columns of loads, differentiable in K and in F.

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

from torchmbd.errors import InputError
from torchmbd.fem.reduction.blocks import BlockFactor, storage
from torchmbd.fem.reduction.forms import Diagonal, Sparse, check, lane_name
from torchmbd.fem.reduction.operator_call import call_as_operator
from torchmbd.fem.reduction.partition import partition
from torchmbd.fem.reduction.shift import SAFE_PIVOT
from torchmbd.fem.reduction.transport import apply_batched
from torchmbd.math.first_derivative import FirstDerivative
from torchmbd.math.sparse import Pattern, SparseMatrix
from torchmbd.math.vmap import batch_first


class StaticLoads:
    """Static solutions for all stiffness matrices of one pattern."""

    def __init__(self, pattern: Pattern) -> None:
        self.form = Sparse(pattern, symmetric=True)
        self.layout = partition(self.form, Diagonal(pattern.size))

    def __call__(self, K: SparseMatrix, F: Float[Tensor, "*lanes N k"]) -> Float[Tensor, "*lanes N k"]:
        """K^-1 F. Raises InputError where K is not positive definite."""
        lanes = np.broadcast_shapes(K.values.shape[:-1], F.shape[:-2])
        values = K.values.expand(*lanes, -1).reshape(-1, K.pattern.nnz)
        columns = F.expand(*lanes, *F.shape[-2:]).reshape(-1, *F.shape[-2:])
        displacements: Any = _Displacements.apply(_Solver(self), values, columns)
        return displacements.reshape(*lanes, *F.shape[-2:])


class _Solver:
    """K^-1 of one call of `StaticLoads`, after `factorize`."""

    factor: BlockFactor

    def __init__(self, of: StaticLoads) -> None:
        self.form, self.layout = of.form, of.layout

    def factorize(self, K: Tensor) -> None:
        check("K", self.form, K)
        self.factor = BlockFactor(self.layout, storage(self.layout, self.form, K))
        weak = self.factor.pivot <= SAFE_PIVOT
        if weak.any():
            lane = lane_name(int(weak.nonzero()[0]), len(K))
            raise InputError(
                f"K{lane} of static loads is not positive definite: something can move without stiffness, or against it; "
                "hold more freedoms"
            )

    def solve(self, F: Tensor) -> Tensor:
        """K^-1 F for columns F [lane, T, N, k]."""
        lanes, T, N, k = F.shape
        flat = F.movedim(1, 2).reshape(lanes, N, T * k).index_select(1, self.layout.order)
        solved = self.factor.solve(flat).index_select(1, self.layout.inverse)
        return solved.reshape(lanes, N, T, k).movedim(2, 1)


class _Displacements(torch.autograd.Function):
    """U [lane, N, k] of K [lane, nnz] and F [lane, N, k]."""

    @staticmethod
    def forward(solver: _Solver, K: Tensor, F: Tensor) -> Tensor:
        solver.factorize(K)
        return solver.solve(F[:, None])[:, 0].contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.solver = inputs[0]
        ctx.save_for_forward(output)
        ctx.save_for_backward(output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, solver: _Solver, K: Tensor, F: Tensor) -> tuple[Tensor, int]:
        K, F = (batch_first(x, dim, info.batch_size) for x, dim in ((K, in_dims[1]), (F, in_dims[2])))
        displacements: Any = _Displacements.apply(solver, K.flatten(0, 1), F.flatten(0, 1))
        return displacements.unflatten(0, (info.batch_size, -1)), 0

    @staticmethod
    def jvp(ctx: Any, _solver: None, dK: Tensor | None, dF: Tensor | None) -> Any:
        (U,) = ctx.saved_tensors
        dK, dF = (None if x is None else x.unsqueeze(1) for x in (dK, dF))
        tangent: Any = _Tangent.apply(ctx.solver, U, dK, dF)
        return tangent.squeeze(1)

    @staticmethod
    def backward(ctx: Any, *G: Tensor) -> tuple[None, Tensor, Tensor]:
        (U,) = ctx.saved_tensors
        K_bar, F_bar = _Cotangent.apply(ctx.solver, U, G[0].unsqueeze(1))  # pyright: ignore[reportGeneralTypeIssues]
        return None, K_bar.squeeze(1), F_bar.squeeze(1)


class _Tangent(FirstDerivative):
    """dU [lane, T, N, k] of dK [lane, T, nnz] and dF [lane, T, N, k]."""

    of = "static displacements"

    @staticmethod
    def forward(solver: _Solver, U: Tensor, dK: Tensor | None, dF: Tensor | None) -> Tensor:
        return call_as_operator(partial(_tangent, solver), U, dK, dF)[0]

    @staticmethod
    def vmap(info: Any, in_dims: tuple, solver: _Solver, *tensors: Tensor | None) -> tuple:
        (dU,), (dim,) = apply_batched(_Tangent, info, in_dims, solver, tensors, state=1)
        return dU, dim


class _Cotangent(FirstDerivative):
    """The cotangents of K [lane, T, nnz] and of F [lane, T, N, k] from that of U [lane, T, N, k]."""

    of = "static displacements"

    @staticmethod
    def forward(solver: _Solver, U: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
        return call_as_operator(partial(_cotangent, solver), U, G)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, solver: _Solver, *tensors: Tensor | None) -> tuple:
        return apply_batched(_Cotangent, info, in_dims, solver, tensors, state=1)


def _tangent(solver: _Solver, U: Tensor, dK: Tensor | None, dF: Tensor | None, *_: None) -> tuple[Tensor, Tensor]:
    loads = 0.0 if dK is None else solver.form.multiply(dK, U[:, None])
    total = -loads if dF is None else dF - loads
    assert isinstance(total, Tensor)
    return solver.solve(total).contiguous(), U.new_zeros(0)


def _cotangent(solver: _Solver, U: Tensor, G: Tensor, *_: None) -> tuple[Tensor, Tensor]:
    Y = solver.solve(G).contiguous()
    return -solver.form.pair(Y, U[:, None]), Y
