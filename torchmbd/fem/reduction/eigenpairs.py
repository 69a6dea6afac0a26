"""Individual modes and frequencies, and their derivatives where they exist.

    K psi_i = lambda_i M psi_i,     psi_i' M psi_j = delta_ij,     lambda_1 <= lambda_2 <= ...

transport.py has the derivatives of the retained span: dPsi outside of it, and the full matrix dKr. Individual modes follow from
the n x n problem Kr R = R Lambda with Kr = Lambda, R = 1 at the design at hand:

    dlambda_i = dKr_ii,     dR_ji = dKr_ji / (lambda_i - lambda_j),     dpsi_i = dPsi_i + sum_j psi_j dR_ji

These are the derivatives of Nelson's method (each is unique); the solves are shared by all modes and directions.

Where eigenvalues meet, with C the block of dKr that belongs to them:

- *Vectors closer than `cluster`*: dR = 0 within. The cluster moves as a span, without turning in itself. (Individual
  vectors are known to rounding / gap, and their derivatives to rounding / gap^2, whatever the method: of K and M rounded
  to double precision more is not to be had. near_modes.py gets that far.)
- *Eigenvalues that are repeated*, that is, closer than rounding can tell. Forward mode: the eigenvalues of C in rising
  order, the one-sided derivatives of the sorted eigenvalues along each direction. They are not linear in the
  direction, for no linear derivative exists where the C of several variables do not commute. Reverse mode: the mean of
  the diagonal of C for each of them, a subgradient in the sense of Clarke.

So at a cluster these derivatives are exact in every mode: of symmetric functions of its eigenvalues alone (their sum, the
sum of their squares), and of functions of its span alone (Psi Psi'). **Functions of values and vectors of a cluster
same, such as Psi g(Lambda) Psi', have none from single pairs**, though they are smooth: g'(lambda) C enters with all
its entries, and dlambda holds only its eigenvalues or the mean of its diagonal. `spectral_function` has their derivatives;
so have functions of `modal_basis` with its full Kr. Reverse mode recognizes such functions, and those of a single vector of a
cluster, by their cotangents, and raises InputError; forward mode cannot, as it does not know what becomes of its tangents.

Along *one* direction individual modes have derivatives even here: `eigenpair_branches` finds them by Dailey's method.
Source: Nelson, AIAA J. 14 (1976) 1201-1205; Dailey, AIAA J. 27 (1989) 486-491; Clarke, Optimization and Nonsmooth
Analysis (1983). Checked in tests/sensitivity/test_eigenpairs.py, tests/sensitivity/test_spectral.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import CLUSTER, modal_basis, parse_pencil, rounding
from torchmbd.fem.reduction.near_modes import ModeSeparation
from torchmbd.fem.reduction.spectral import chained
from torchmbd.math.first_derivative import FirstDerivative
from torchmbd.math.sparse import SparseMatrix
from torchmbd.math.vmap import batch_first

UNEQUAL = 1e-4  # of cotangents; less is what distinct eigenvalues of a cluster make of a symmetric function


class Eigenpairs(NamedTuple):
    """Eigenvalues [..., n], lowest first, and M-orthonormal vectors [..., N, n]."""

    values: Float[Tensor, "*lanes modes"]
    vectors: Float[Tensor, "*lanes freedoms modes"]


def eigenpairs(K: Tensor | SparseMatrix, M: Tensor | SparseMatrix, n: int, cluster: float = CLUSTER) -> Eigenpairs:
    """Find the n lowest modes of K psi = lambda M psi.

    K        dense [..., N, N] or SparseMatrix
    M        the same, or a vector [..., N], the diagonal of a lumped mass
    cluster  relative distance below which neighbors are one cluster, which n must not cut; see the module header

    Raises InputError as modal_basis does. A backward pass through values and vectors of one cluster same, or through
    one of its vectors alone, raises it too.

    >>> K = torch.tensor([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]], dtype=torch.float64, requires_grad=True)
    >>> values, vectors = mbd.eigenpairs(K, torch.ones(3, dtype=torch.float64), 1)
    >>> values.sum().backward()
    >>> K.grad.round(decimals=3).tolist()  # psi psi'
    [[0.25, 0.354, 0.25], [0.354, 0.5, 0.354], [0.25, 0.354, 0.25]]
    """
    basis = modal_basis(K, M, n, cluster)
    pencil, K_values, M_values, lanes = parse_pencil(K, M, n)
    K_values, M_values, Kr, psi = (x.detach() for x in (K_values, M_values, *basis[::-1]))
    accuracy = rounding(pencil, K_values, M_values)
    values = Kr.diagonal(dim1=-2, dim2=-1).reshape(-1, n)
    apart = ~same_cluster(values, accuracy, cluster)
    turn = ModeSeparation.apply(pencil, K_values, M_values, psi.reshape(-1, *psi.shape[-2:]), apart).reshape(
        *lanes, n, n
    )
    values, R = _Split.apply(turn.mT @ basis.stiffness @ turn, accuracy.reshape(lanes), cluster)
    return Eigenpairs(values, basis.vectors @ (turn @ R))


def same_cluster(values: Tensor, accuracy: Tensor, cluster: float) -> Tensor:
    """Return which pairs of eigenvalues are in one cluster [..., n, n]."""
    return chained(values, torch.maximum(cluster * values[..., 1:].abs(), accuracy[..., None]))


class _Split(torch.autograd.Function):
    """Eigenvalues and eigenvectors R of the reduced stiffness, which is diagonal at the design at hand."""

    generate_vmap_rule = True

    @staticmethod
    def forward(Kr: Tensor, accuracy: Tensor, cluster: float) -> tuple[Tensor, Tensor]:
        values = Kr.diagonal(dim1=-2, dim2=-1).clone()
        return values, torch.diag_embed(torch.ones_like(values))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.cluster = inputs[2]
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(output[0], inputs[1])
        ctx.save_for_backward(output[0], inputs[1])

    @staticmethod
    def jvp(ctx: Any, dKr: Tensor, _accuracy: Any, _cluster: Any) -> tuple[Tensor, Tensor]:
        values, accuracy = ctx.saved_tensors
        repeated = chained(values, accuracy[..., None])
        return _Slopes.apply(dKr, repeated), dKr * _inverse_gaps(values, accuracy, ctx.cluster)

    @staticmethod
    def backward(ctx: Any, g: Tensor | None, G: Tensor | None) -> tuple[Tensor, None, None]:
        values, accuracy = ctx.saved_tensors
        bar = torch.diag_embed(torch.zeros_like(values))
        if g is not None:
            repeated = chained(values, accuracy[..., None])
            share = repeated.to(g.dtype) / repeated.sum(-1, keepdim=True)
            bar = bar + torch.diag_embed((share @ g[..., None]).squeeze(-1))
        if G is not None:
            bar = bar + _refuse_single(values, accuracy, ctx.cluster, torch.zeros_like(values) if g is None else g, G)
            turned = G * _inverse_gaps(values, accuracy, ctx.cluster)
            bar = bar + (turned + turned.mT) / 2
        return bar, None, None


@torch.library.custom_op("torchmbd::refuse_single_modes", mutates_args=())
def _refuse_single(values: Tensor, accuracy: Tensor, cluster: float, g: Tensor, G: Tensor) -> Tensor:
    """Zeros [..., n, n]; InputError where the cotangents g [..., n], G [..., n, n] tell one mode of a cluster from another.

    A function of a span has a symmetric block of G, one of its values alone has equal g. It is an operator of torch, because
    under vmap a Python function cannot read numbers.
    """
    near = same_cluster(values, accuracy, cluster)
    inside = torch.where(near, G, 0.0).abs().amax(-1)  # [..., n]
    size = G.abs().amax((-2, -1))
    turned = torch.where(near, (G - G.mT).abs(), 0.0).amax(-1) > UNEQUAL * size[..., None]
    low, high = (torch.where(near, g[..., None, :], sign * torch.inf) for sign in (1, -1))
    unequal = high.amax(-1) - low.amin(-1) > UNEQUAL * g.abs().amax(-1, keepdim=True)
    wrong = turned | (unequal & (inside > UNEQUAL * size[..., None]))
    if wrong.any():
        lane, mode = (int(i) for i in wrong.reshape(-1, wrong.shape[-1]).nonzero()[0])
        labels = near.reshape(-1, *near.shape[-2:])[lane, mode].nonzero().squeeze(-1) + 1
        raise InputError(
            f"modes {', '.join(map(str, labels.tolist()))} coincide, and a gradient by single ones of their vectors, or by "
            "values and vectors same, was asked for, which is not to be had from pairs; allowed: functions of their "
            "values alone or of their span alone, spectral_function, modal_basis, eigenpair_branches along one direction"
        )
    return torch.zeros_like(G)


@_refuse_single.register_vmap
def _(info: Any, in_dims: tuple, values: Tensor, accuracy: Tensor, cluster: float, g: Tensor, G: Tensor) -> tuple:
    pairs = zip((values, accuracy, g, G), (*in_dims[:2], *in_dims[3:]), strict=True)
    values, accuracy, g, G = (batch_first(x, dim, info.batch_size) for x, dim in pairs)
    return _refuse_single(values, accuracy, cluster, g, G), 0


def _inverse_gaps(values: Tensor, accuracy: Tensor, cluster: float) -> Tensor:
    """1 / (lambda_i - lambda_j) at [j, i], zero within clusters."""
    same = same_cluster(values, accuracy, cluster)
    gaps = values[..., None, :] - values[..., :, None]
    return torch.where(same, 0.0, 1 / torch.where(same, 1.0, gaps))


class _Slopes(FirstDerivative):
    """The eigenvalues of each cluster's block of dKr [..., n, n], in rising order; its diagonal for single modes."""

    of = "modes"

    @staticmethod
    def forward(dKr: Tensor, same: Tensor) -> Tensor:
        slopes = dKr.diagonal(dim1=-2, dim2=-1).clone()
        n = dKr.shape[-1]
        flat, blocks = slopes.view(-1, n), dKr.reshape(-1, n, n)
        labels = same.expand(dKr.shape).reshape(-1, n, n)
        for row in (labels.sum(-1) > 1).any(-1).nonzero().squeeze(-1).tolist():
            start = 0
            while start < n:
                end = start + int(labels[row, start].sum())
                block = blocks[row, start:end, start:end]
                flat[row, start:end] = torch.linalg.eigvalsh((block + block.mT) / 2)
                start = end
        return slopes

    @staticmethod
    def vmap(info: Any, in_dims: tuple, dKr: Tensor, same: Tensor) -> tuple[Tensor, int]:
        size = info.batch_size
        return _Slopes.apply(batch_first(dKr, in_dims[0], size), batch_first(same, in_dims[1], size)), 0
