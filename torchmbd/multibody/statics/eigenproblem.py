"""The eigenproblem of buckling, -Kg x = (1 / factor) K x, on sparse matrices of one pattern.

A dense method below SMALL freedoms, else that of Lanczos; derivatives are those of K and Kg between the vectors found.
Checked in tests/multibody/statics/test_buckling.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.reduction import eigenvalues
from torchmbd.math.sparse import Pattern, SparseMatrix

SMALL = 400  # freedoms; below, a dense method costs no more
GUARD = 4  # eigenvalues beyond those asked for, so that the members of a cluster are known
NONE = 1e-7  # of the largest eigenvalue of either sign: what is below is none
RESTARTS = 100  # of Lanczos's method


def eigenproblem(
    pattern: Pattern, K: Float[Tensor, "*lanes nnz"], Kg: Float[Tensor, "*lanes nnz"], number: int
) -> tuple[Float[Tensor, "*lanes number"], Float[Tensor, "*lanes N number"]]:
    """1 / factors, falling, with their derivatives, zero where there is none; and their vectors, which have no derivative."""
    lanes, n = K.shape[:-1], pattern.size
    some = min(number + GUARD, n)
    flat, scale = _Vectors.apply(pattern, some, K.reshape(-1, pattern.nnz), Kg.reshape(-1, pattern.nnz))
    vectors, scale = flat.reshape(*lanes, n, some), scale.reshape(*lanes, 1)
    a, b = (vectors.mT @ (SparseMatrix(pattern, values) @ vectors) for values in (K, Kg))
    missing = torch.diag_embed((vectors == 0.0).all(-2).to(a.dtype))
    inverse = inverse_factors(a + missing, b)[..., :number]
    return torch.where(inverse > NONE * scale, inverse, 0.0), vectors[..., :number]


def inverse_factors(a: Float[Tensor, "*lanes n n"], b: Float[Tensor, "*lanes n n"]) -> Float[Tensor, "*lanes n"]:
    """1 / factors, falling, of a stiffness a and a geometric stiffness b between a few vectors."""
    L = torch.linalg.cholesky(0.5 * (a + a.mT))
    half = torch.linalg.solve_triangular(L, 0.5 * (b + b.mT), upper=False)
    Kr = torch.linalg.solve_triangular(L, half.mT, upper=False)
    return -eigenvalues(0.5 * (Kr + Kr.mT))


class _Vectors(torch.autograd.Function):
    """Eigenvectors [lane, N, some] of Kg x = value K x of the lowest values, K-orthonormal, by rising value, zero where there
    is none below zero; and the largest value of either sign [lane]. Numbers without a derivative: the derivative of an
    eigenvalue needs none of its vector."""

    @staticmethod
    def forward(pattern: Pattern, some: int, K: Tensor, Kg: Tensor) -> tuple[Tensor, Tensor]:
        found = [lowest_vectors(pattern, a, b, some) for a, b in zip(K, Kg, strict=True)]
        vectors, scale = zip(*found, strict=True)
        return torch.stack(vectors), torch.tensor(scale, dtype=K.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.mark_non_differentiable(*output)
        ctx.shapes = [x.shape for x in output]

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Any:
        return None, None

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        return None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, pattern: Pattern, some: int, K: Tensor, Kg: Tensor) -> Any:
        wide = (
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in ((K, in_dims[2]), (Kg, in_dims[3]))
        )
        outputs = _Vectors.apply(pattern, some, *(x.flatten(0, 1) for x in wide))
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in outputs), (0, 0)  # pyright: ignore


def lowest_vectors(pattern: Pattern, K: Tensor, Kg: Tensor, some: int) -> tuple[Tensor, float]:
    """Of one lane."""
    A, B = pattern.to_scipy(Kg), pattern.to_scipy(K)
    if pattern.size <= max(SMALL, 4 * some):
        values, found = scipy.linalg.eigh(A.toarray(), B.toarray())
        scale, values, found = np.abs(values).max(), values[:some], found[:, :some]
    else:
        factor = scipy.sparse.linalg.splu(B.tocsc())
        inverse = scipy.sparse.linalg.LinearOperator(B.shape, factor.solve, dtype=float)  # pyright: ignore
        options: dict[str, Any] = {
            "M": B,
            "Minv": inverse,
            "v0": np.random.default_rng(0).standard_normal(pattern.size),
        }
        largest = scipy.sparse.linalg.eigsh(A, 1, which="LM", tol=1e-2, **options)  # pyright: ignore
        scale = float(abs(largest[0][0]))
        try:
            values, found = scipy.sparse.linalg.eigsh(A, some, which="SA", maxiter=RESTARTS, **options)
        except scipy.sparse.linalg.ArpackNoConvergence as error:  # the others crowd at zero: loads that stiffen
            values, found = error.eigenvalues, error.eigenvectors
    order = [i for i in np.argsort(values) if values[i] < -NONE * scale]
    vectors = np.zeros((pattern.size, some))
    vectors[:, : len(order)] = found[:, order]
    return torch.from_numpy(vectors), float(scale)
