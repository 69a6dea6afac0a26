"""The eigenproblem of buckling, -Kg x = (1 / factor) K x, on sparse matrices of one pattern.

Solved by a dense method below SMALL degrees of freedom, else by Lanczos's method; derivatives are those of K and Kg between
eigenvectors. Checked in tests/extensions/buckling/test_buckling.py.
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

SMALL = 400  # freedoms below which a dense method costs no more
GUARD = 4  # eigenvalues beyond the requested ones, so that clusters at their end are complete
NONE = 1e-7  # share of the largest eigenvalue of either sign below which an eigenvalue is zero
RESTARTS = 100  # largest number of restarts of Lanczos's method


def eigenproblem(
    pattern: Pattern, K: Float[Tensor, "*lanes nnz"], Kg: Float[Tensor, "*lanes nnz"], number: int
) -> tuple[Float[Tensor, "*lanes number"], Float[Tensor, "*lanes N number"]]:
    """1 / factors, descending, with derivatives, zero where there is no further one; and their vectors, without derivatives."""
    lanes, n = K.shape[:-1], pattern.size
    count = min(number + GUARD, n)
    flat, scale = _Vectors.apply(pattern, count, K.reshape(-1, pattern.nnz), Kg.reshape(-1, pattern.nnz))
    vectors, scale = flat.reshape(*lanes, n, count), scale.reshape(*lanes, 1)
    a, b = (vectors.mT @ (SparseMatrix(pattern, values) @ vectors) for values in (K, Kg))
    missing = torch.diag_embed((vectors == 0.0).all(-2).to(a.dtype))
    inverse = inverse_factors(a + missing, b)[..., :number]
    return torch.where(inverse > NONE * scale, inverse, 0.0), vectors[..., :number]


def inverse_factors(a: Float[Tensor, "*lanes n n"], b: Float[Tensor, "*lanes n n"]) -> Float[Tensor, "*lanes n"]:
    """1 / factors, descending, of a stiffness a and a geometric stiffness b in a subspace."""
    L = torch.linalg.cholesky(0.5 * (a + a.mT))
    half = torch.linalg.solve_triangular(L, 0.5 * (b + b.mT), upper=False)
    Kr = torch.linalg.solve_triangular(L, half.mT, upper=False)
    return -eigenvalues(0.5 * (Kr + Kr.mT))


class _Vectors(torch.autograd.Function):
    """Eigenvectors [lane, N, count] of Kg x = value K x of the lowest values, K-orthonormal, by ascending value, zero in place
    of those with values above zero; and the largest value of either sign [lane]. Without derivatives, as the derivative of an
    eigenvalue does not need that of its vector."""

    @staticmethod
    def forward(pattern: Pattern, count: int, K: Tensor, Kg: Tensor) -> tuple[Tensor, Tensor]:
        of_lanes = [lowest_vectors(pattern, a, b, count) for a, b in zip(K, Kg, strict=True)]
        vectors, scale = zip(*of_lanes, strict=True)
        return torch.stack(vectors), torch.tensor(scale, dtype=K.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.mark_non_differentiable(*output)

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


def lowest_vectors(pattern: Pattern, K: Tensor, Kg: Tensor, count: int) -> tuple[Tensor, float]:
    """Eigenvectors [N, count] of one lane for the lowest eigenvalues of Kg by K, and the largest eigenvalue of either sign."""
    A, B = pattern.to_scipy(Kg), pattern.to_scipy(K)
    if pattern.size <= max(SMALL, 4 * count):
        values, shapes = scipy.linalg.eigh(A.toarray(), B.toarray())
        scale, values, shapes = np.abs(values).max(), values[:count], shapes[:, :count]
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
            values, shapes = scipy.sparse.linalg.eigsh(A, count, which="SA", maxiter=RESTARTS, **options)
        except scipy.sparse.linalg.ArpackNoConvergence as error:  # the others cluster at zero, as of loads that stiffen
            values, shapes = error.eigenvalues, error.eigenvectors
    order = [i for i in np.argsort(values) if values[i] < -NONE * scale]
    vectors = np.zeros((pattern.size, count))
    vectors[:, : len(order)] = shapes[:, order]
    return torch.from_numpy(vectors), float(scale)
