"""The balanced inverse: many units, derivatives, lanes."""

from __future__ import annotations

import torch
from torch.func import jacfwd, jacrev, vmap
from torch.testing import assert_close

from torchmbd.math.inverse import balanced_inverse


def matrices(*lanes: int) -> torch.Tensor:
    """Positive definite, with diagonal entries from 1e-4 to 1e8."""
    make = torch.Generator().manual_seed(4)
    A = torch.randn(*lanes, 6, 6, generator=make, dtype=torch.float64)
    size = torch.logspace(-2, 4, 6, dtype=torch.float64)
    return (A @ A.mT + 2 * torch.eye(6, dtype=torch.float64)) * size[:, None] * size


def test_inverse_of_many_units():
    A = matrices(5)
    product, d = balanced_inverse(A) @ A, A.diagonal(dim1=-2, dim2=-1).sqrt()
    assert_close(product * d[:, :, None] / d[:, None], torch.eye(6).double().expand(5, 6, 6), rtol=0, atol=1e-13)


def test_derivatives_on_lanes():
    """dX = -X dA X, forward and reverse, under vmap."""
    A = matrices(3)
    X = torch.linalg.inv(A)
    exact = -torch.einsum("lij,lmn->lijmn", X, X).permute(0, 1, 3, 2, 4)  # X_ij X_mn -> d X_im / d A_jn
    scale = A.diagonal(dim1=-2, dim2=-1).sqrt()
    weight = torch.einsum("li,lm,lj,ln->limjn", scale, scale, scale, scale)
    for derivative in (jacfwd, jacrev):
        assert_close(vmap(derivative(balanced_inverse))(A) * weight, exact * weight, rtol=0, atol=1e-10)
