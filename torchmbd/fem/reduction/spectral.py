"""Functions of the retained modes that stay smooth where eigenvalues cross or repeat.

    U = Psi g(Kr) Psi',      dU = dPsi g(Kr) Psi' + Psi dg Psi' + Psi g(Kr) dPsi'
    dg = V (D o (V' dKr V)) V',      D_ij = (g(l_i) - g(l_j)) / (l_i - l_j),   g'(l_i) where they are equal

Kr = V diag(l) V'. dPsi is that of basis.py: outside of the span, a solve in which only gaps to discarded modes appear.
dg is the formula of Daleckii and Krein: no basis of a cluster is preferred, so U has one derivative at every design, in
forward and in reverse mode, along all directions at once. Functions of the single pairs of `eigenpairs` have not.

D_ij is the quotient, or the same number as the integral of g'(l_j + t (l_i - l_j)) over t from 0 to 1 by three Gauss
points, whichever loses fewer digits. Differentiable once.
Source: Daleckii and Krein, AMS Transl. (2) 47 (1965) 1-30; Higham, Functions of Matrices (2008), section 3.2; Clarke,
Optimization and Nonsmooth Analysis (1983). Checked in tests/sensitivity/test_spectral.py.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import CLUSTER, ModalBasis

#: Three, then two Gauss points.
NODES = (0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5, 0.5 - 0.75**0.5 / 3, 0.5 + 0.75**0.5 / 3)


def spectral_function(
    basis: ModalBasis, g: Callable[[Tensor], Tensor], columns: Float[Tensor, "*lanes freedoms k"] | None = None
) -> Float[Tensor, "*lanes freedoms k"]:
    """Psi g(Kr) Psi' [..., N, N], or its product with columns [..., N, k], which never makes the square matrix.

    basis    of modal_basis or craig_bampton; derivatives are those of its K and M
    g        of eigenvalues of any shape, element by element, in torch operations, with a derivative between any two of
             them, such as `lambda x: torch.exp(-x * t)`. Other tensors in it have their gradients too

    Source: module header. Raises InputError if g does not return a float64 tensor of the shape that it is given.

    >>> K = torch.tensor([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]], dtype=torch.float64)
    >>> basis = mbd.reduction.modal_basis(K, torch.ones(3, dtype=torch.float64), 3)
    >>> root = mbd.reduction.spectral_function(basis, torch.sqrt)
    >>> torch.allclose(root @ root, K)
    True
    """
    dKr = basis.stiffness - basis.stiffness.detach()  # zero, with the derivatives of Kr
    values, V = torch.linalg.eigh(basis.stiffness.detach())
    inner = torch.diag_embed(_applied(g, values)) + _divided_differences(g, values) * (V.mT @ dKr @ V)
    Psi = basis.vectors @ V
    return Psi @ inner @ (Psi.mT if columns is None else Psi.mT @ columns)


def eigenvalues(Kr: Float[Tensor, "*lanes n n"]) -> Float[Tensor, "*lanes n"]:
    """Eigenvalues of a symmetric matrix in rising order; those that coincide have the mean of their derivatives.

    Their mean is the derivative of every symmetric function of a cluster, and for each alone a subgradient in the sense
    of Clarke; forward and reverse mode agree. Neighbors coincide where their relative distance is below CLUSTER.
    """
    values, V = torch.linalg.eigh(Kr.detach())
    slopes = (V.mT @ (Kr - Kr.detach()) @ V).diagonal(dim1=-2, dim2=-1)  # zero, with the derivatives of Kr
    share = chained(values, CLUSTER * values[..., 1:].abs()).to(values.dtype)
    return values + (share @ slopes[..., None]).squeeze(-1) / share.sum(-1)


def chained(values: Tensor, distance: Tensor) -> Tensor:
    """Which sorted eigenvalues [..., n] are chained by steps of at most `distance` [..., n - 1 or 1]: [..., n, n]."""
    label = torch.nn.functional.pad((values.diff(dim=-1) > distance).cumsum(-1), (1, 0))
    return label[..., :, None] == label[..., None, :]


def _divided_differences(g: Callable[[Tensor], Tensor], values: Tensor) -> Tensor:
    """D [..., n, n] of eigenvalues [..., n]."""
    gap = values[..., :, None] - values[..., None, :]
    images = _applied(g, values)
    points = torch.stack([values[..., None, :] + t * gap for t in NODES])
    slope, back, *_ = torch.func.vjp(g, points)
    a, b, c, d, e = back(torch.ones_like(slope))[0].unbind()
    three, two = (5 * a + 8 * b + 5 * c) / 18, (d + e) / 2
    quotient = (images[..., :, None] - images[..., None, :]) / torch.where(gap == 0, 1.0, gap)
    size = images.abs()
    lost = torch.finfo(values.dtype).eps * (size[..., :, None] + size[..., None, :])
    return torch.where(lost >= (three - two).abs() * gap.abs(), three, quotient)


def _applied(g: Callable[[Tensor], Tensor], values: Tensor) -> Tensor:
    result = g(values)
    if not isinstance(result, Tensor) or result.shape != values.shape or result.dtype != values.dtype:
        kind = f"shape {tuple(result.shape)} of {result.dtype}" if isinstance(result, Tensor) else repr(result)
        raise InputError(
            "g",
            allowed=f"must return float64 of shape {tuple(values.shape)}, the shape of its argument",
            state=f"returned {kind}",
        )
    return result
