"""Individual modes and frequencies, and their derivatives where they exist.

    K psi_i = lambda_i M psi_i,     psi_i' M psi_j = delta_ij,     lambda_1 <= lambda_2 <= ...

The retained span moves as transport.py says: dPsi outside of it, and the full matrix dKr. What is left is the n x n
problem Kr R = R Lambda with Kr = Lambda, R = 1 at the design at hand:

    dlambda_i = dKr_ii,     dR_ji = dKr_ji / (lambda_i - lambda_j),     dpsi_i = dPsi_i + sum_j psi_j dR_ji

These are the derivatives of Nelson's method (each is unique); the solves are shared by all modes and directions.

What happens where eigenvalues meet, C being the block of dKr that belongs to them:

- *Vectors closer than `cluster`*: dR = 0 within. The cluster moves as a span, without turning in itself. (Individual
  vectors are known to rounding / gap, and their derivatives to rounding / gap^2, whatever the method: of K and M rounded
  to double precision more is not to be had. near_modes.py gets that far.)
- *Eigenvalues that are repeated*, that is, closer than rounding can tell. Forward mode: the eigenvalues of C in rising
  order, the one-sided derivatives of the sorted eigenvalues along each direction. They are not linear in the
  direction, for no linear derivative exists where the C of several variables do not commute. Reverse mode: the mean of
  the diagonal of C for each of them, a subgradient in the sense of Clarke.

So at a cluster these derivatives are exact in every mode: of symmetric functions of its eigenvalues alone (their sum, the
sum of their squares), and of functions of its span alone (Psi Psi'). **Functions of values and vectors of a cluster
together, such as Psi g(Lambda) Psi', have none from single pairs**, though they are smooth: g'(lambda) C enters with all
its entries, and dlambda holds only its eigenvalues or the mean of its diagonal. `spectral_function` has their derivatives;
so has whatever is made of `modal_basis` with its full Kr. Reverse mode sees such a use, and that of a single vector of a
cluster, by the cotangents, and refuses it; forward mode cannot see what becomes of its tangents.

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
from torchmbd.fem.reduction.basis import CLUSTER, modal_basis, open_pencil, rounding
from torchmbd.fem.reduction.near_modes import Sharpen
from torchmbd.fem.reduction.spectral import chained
from torchmbd.math.first_derivative import FirstDerivative
from torchmbd.math.sparse import SparseMatrix

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

    Raises InputError as modal_basis does. A backward pass through values and vectors of one cluster together, or through
    one of its vectors alone, raises it too.

    >>> K = torch.tensor([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]], dtype=torch.float64, requires_grad=True)
    >>> values, vectors = mbd.eigenpairs(K, torch.ones(3, dtype=torch.float64), 1)
    >>> values.sum().backward()
    >>> K.grad.round(decimals=3).tolist()  # psi psi'
    [[0.25, 0.354, 0.25], [0.354, 0.5, 0.354], [0.25, 0.354, 0.25]]
    """
    basis = modal_basis(K, M, n, cluster)
    pencil, K_values, M_values, lanes = open_pencil(K, M, n)
    K_values, M_values, Kr, psi = (x.detach() for x in (K_values, M_values, *basis[::-1]))
    known_to = rounding(pencil, K_values, M_values)
    values = Kr.diagonal(dim1=-2, dim2=-1).reshape(-1, n)
    apart = ~clusters(values, known_to, cluster)
    turn = Sharpen.apply(pencil, K_values, M_values, psi.reshape(-1, *psi.shape[-2:]), apart).reshape(*lanes, n, n)
    values, R = _Split.apply(turn.mT @ basis.stiffness @ turn, known_to.reshape(lanes), cluster)
    return Eigenpairs(values, basis.vectors @ (turn @ R))


def clusters(values: Tensor, known_to: Tensor, cluster: float) -> Tensor:
    """Which eigenvalues are too near to have vectors of their own [..., n, n]."""
    return chained(values, torch.maximum(cluster * values[..., 1:].abs(), known_to[..., None]))


class _Split(torch.autograd.Function):
    """From the reduced stiffness, diagonal at the design at hand, to eigenvalues and the turn to individual modes."""

    generate_vmap_rule = True

    @staticmethod
    def forward(Kr: Tensor, known_to: Tensor, cluster: float) -> tuple[Tensor, Tensor]:
        values = Kr.diagonal(dim1=-2, dim2=-1).clone()
        return values, torch.diag_embed(torch.ones_like(values))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.cluster = inputs[2]
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(output[0], inputs[1])
        ctx.save_for_backward(output[0], inputs[1])

    @staticmethod
    def jvp(ctx: Any, dKr: Tensor, _known_to: Any, _cluster: Any) -> tuple[Tensor, Tensor]:
        values, known_to = ctx.saved_tensors
        repeated = chained(values, known_to[..., None])
        return _Slopes.apply(dKr, repeated), dKr * _inverse_gaps(values, known_to, ctx.cluster)

    @staticmethod
    def backward(ctx: Any, g: Tensor | None, G: Tensor | None) -> tuple[Tensor, None, None]:
        values, known_to = ctx.saved_tensors
        bar = torch.diag_embed(torch.zeros_like(values))
        if g is not None:
            repeated = chained(values, known_to[..., None])
            share = repeated.to(g.dtype) / repeated.sum(-1, keepdim=True)
            bar = bar + torch.diag_embed((share @ g[..., None]).squeeze(-1))
        if G is not None:
            bar = bar + _refuse_single(values, known_to, ctx.cluster, torch.zeros_like(values) if g is None else g, G)
            turned = G * _inverse_gaps(values, known_to, ctx.cluster)
            bar = bar + (turned + turned.mT) / 2
        return bar, None, None


@torch.library.custom_op("torchmbd::refuse_single_modes", mutates_args=())
def _refuse_single(values: Tensor, known_to: Tensor, cluster: float, g: Tensor, G: Tensor) -> Tensor:
    """Zeros [..., n, n]; InputError where the cotangents g [..., n], G [..., n, n] tell one mode of a cluster from another.

    A function of a span has a symmetric block of G, one of its values alone has equal g. An operator of its own, for it
    looks at numbers, which vmap does not show to Python.
    """
    near = clusters(values, known_to, cluster)
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
            "values and vectors together, was asked for, which is not to be had from pairs; allowed: functions of their "
            "values alone or of their span alone, spectral_function, modal_basis, eigenpair_branches along one direction"
        )
    return torch.zeros_like(G)


@_refuse_single.register_vmap
def _(info: Any, in_dims: tuple, values: Tensor, known_to: Tensor, cluster: float, g: Tensor, G: Tensor) -> tuple:
    wide = (
        x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
        for x, dim in zip((values, known_to, g, G), (*in_dims[:2], *in_dims[3:]), strict=True)
    )
    values, known_to, g, G = wide
    return _refuse_single(values, known_to, cluster, g, G), 0


def _inverse_gaps(values: Tensor, known_to: Tensor, cluster: float) -> Tensor:
    """1 / (lambda_i - lambda_j) at [j, i], zero within clusters."""
    together = clusters(values, known_to, cluster)
    gaps = values[..., None, :] - values[..., :, None]
    return torch.where(together, 0.0, 1 / torch.where(together, 1.0, gaps))


class _Slopes(FirstDerivative):
    """The eigenvalues of each cluster's block of dKr [..., n, n], in rising order; its diagonal for single modes."""

    of = "modes"

    @staticmethod
    def forward(dKr: Tensor, together: Tensor) -> Tensor:
        slopes = dKr.diagonal(dim1=-2, dim2=-1).clone()
        n = dKr.shape[-1]
        flat, blocks = slopes.view(-1, n), dKr.reshape(-1, n, n)
        labels = together.expand(dKr.shape).reshape(-1, n, n)
        for row in (labels.sum(-1) > 1).any(-1).nonzero().squeeze(-1).tolist():
            start = 0
            while start < n:
                end = start + int(labels[row, start].sum())
                block = blocks[row, start:end, start:end]
                flat[row, start:end] = torch.linalg.eigvalsh((block + block.mT) / 2)
                start = end
        return slopes

    @staticmethod
    def vmap(info: Any, in_dims: tuple, dKr: Tensor, together: Tensor) -> tuple[Tensor, int]:
        wide = [
            x.expand(info.batch_size, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in ((dKr, in_dims[0]), (together, in_dims[1]))
        ]
        return _Slopes.apply(*wide), 0
