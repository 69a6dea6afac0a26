"""Quadratic forms d' L d at points for several matrices L, summed over the points.

    y_k = sum_points sum_ij L_k,ij d_i' d_j          d_i [s, a]: row i at a point of a vectors;  L symmetric;  y [a, a]

Compiled code computes one design after another (products.py). Without it, torch computes groups of points: the
products d_i' d_j of all points and designs would not fit into the cache of the processor.
Differentiable once in L and d, forward and reverse. Checked in tests/math/test_quadratic_forms.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.math.products import compiled_products
from torchmbd.math.vmap import FirstDerivative, apply_as_lanes

GROUP = 64  # points


def quadratic_forms(
    law: Float[Tensor, "*lanes k p pairs"], d: Float[Tensor, "*lanes p r s a"]
) -> Float[Tensor, "*lanes k a a"]:
    """Return the sums of all laws; a law is given by its `factors`."""
    a = d.shape[-1]
    lanes = np.broadcast_shapes(law.shape[:-3], d.shape[:-4])
    law, d = (x.expand(*lanes, *x.shape[-n:]).reshape(-1, *x.shape[-n:]) for x, n in ((law, 3), (d, 4)))
    sums: Any = _Forms.apply(law, d)
    return sums.reshape(*lanes, -1, a, a)


def factors(L: Float[Tensor, "*any r r"]) -> Float[Tensor, "*any pairs"]:
    """Return the factors of d_i' d_j, i <= j, row by row: the upper triangle, doubled off the diagonal."""
    r = L.shape[-1]
    i, j = torch.triu_indices(r, r)
    return L.flatten(-2).index_select(-1, i * r + j) * (2 - (i == j).to(L.dtype))


def matrices(law: Float[Tensor, "*any pairs"], r: int) -> Float[Tensor, "*any r r"]:
    """Return the matrices L [r, r] of `factors`."""
    i, j = torch.triu_indices(r, r)
    pair = torch.zeros(r, r, dtype=torch.long)
    pair[i, j] = pair[j, i] = torch.arange(len(i))
    half = 0.5 * (1 + (i == j).to(law.dtype))
    return (law * half).index_select(-1, pair.flatten()).unflatten(-1, (r, r))


class _Forms(torch.autograd.Function):
    """y [lane, k, a, a] of factors of laws [lane, k, p, ij] and of d [lane, p, r, s, a]."""

    @staticmethod
    def forward(law: Tensor, d: Tensor) -> Tensor:
        return _symmetric(_sums(law, d, d))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.save_for_forward(*inputs)
        ctx.save_for_backward(*inputs)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *x: Tensor) -> Any:
        return apply_as_lanes(_Forms.apply, info, in_dims, *x)

    @staticmethod
    def jvp(ctx: Any, d_law: Tensor | None, d_d: Tensor | None) -> Any:
        law, d = ctx.saved_tensors
        parts: list[Any] = [] if d_law is None else [_Cross.apply(d_law, d, 0.5 * d)]
        parts += [] if d_d is None else [_Cross.apply(law, d, d_d)]
        return sum(parts)

    @staticmethod
    def backward(ctx: Any, *G: Tensor) -> Any:
        return _Slopes.apply(*ctx.saved_tensors, G[0])


class _Cross(FirstDerivative):
    """The sums with d_i' e_j + e_i' d_j in place of d_i' d_j: the derivative along e."""

    of = "quadratic forms"

    @staticmethod
    def forward(law: Tensor, d: Tensor, e: Tensor) -> Tensor:
        return _symmetric(_sums(law, d, e))

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *x: Tensor) -> Any:
        return apply_as_lanes(_Cross.apply, info, in_dims, *x)


class _Slopes(FirstDerivative):
    """Cotangents of law and d from those of y."""

    of = "quadratic forms"

    @staticmethod
    def forward(law: Tensor, d: Tensor, G: Tensor) -> tuple[Tensor, Tensor]:
        G = _symmetric(G)
        if (code := compiled_products(d)) is not None:
            return code.quadratic_slopes(law, d, G)
        i, j = torch.triu_indices(d.shape[2], d.shape[2])
        by_law, by_d = torch.empty_like(law), torch.zeros_like(d)
        for points in torch.arange(d.shape[1]).split(GROUP):
            first, second = (d[:, points[:, None], k] for k in (i, j))  # [lane, p, ij, s, a]
            by_law[:, :, points] = torch.einsum("lpqsa,lpqsb,lkab->lkpq", first, second, G)
            H = torch.einsum("lkpq,lkab->lpqab", law[:, :, points], G)
            by_d[:, points] = by_d[:, points].index_add(2, i, second @ H).index_add(2, j, first @ H)
        return by_law, by_d

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *x: Tensor) -> Any:
        return apply_as_lanes(_Slopes.apply, info, in_dims, *x)


def _sums(law: Tensor, d: Tensor, e: Tensor) -> Tensor:
    if (code := compiled_products(d)) is not None:
        return code.quadratic_forms(law, d, e)
    i, j = torch.triu_indices(d.shape[2], d.shape[2])
    total = d.new_zeros(len(law), law.shape[1], d.shape[-1], d.shape[-1])
    for points in torch.arange(d.shape[1]).split(GROUP):
        at = points[:, None]
        rows = d[:, at, i].mT @ e[:, at, j]
        rows = rows if e is d else rows + e[:, at, i].mT @ d[:, at, j]
        total += torch.einsum("lkpq,lpqab->lkab", law[:, :, points], rows)
    return total


def _symmetric(y: Tensor) -> Tensor:
    return 0.5 * (y + y.mT)
