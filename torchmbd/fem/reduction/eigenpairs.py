"""Individual modes and frequencies, and their derivatives where they exist.

    K psi_i = lambda_i M psi_i,     psi_i' M psi_j = delta_ij,     lambda_1 <= lambda_2 <= ...

transport.py has the derivatives of the retained span: dPsi outside of it, and the full matrix dKr. Individual modes follow from
the n x n problem Kr R = R Lambda with Kr = Lambda, R = 1 at the design at hand:

    dlambda_i = dKr_ii,     dR_ji = dKr_ji / (lambda_i - lambda_j),     dpsi_i = dPsi_i + sum_j psi_j dR_ji

These are the derivatives of Nelson's method (each is unique); the solves are shared by all modes and directions.

Where eigenvalues meet, with C the block of dKr that belongs to them:

- *Eigenvalues that are repeated*, that is, closer than rounding can tell. Which vectors of their span are returned is a matter
  of choice, Psi Q. Forward mode: those for which Q' C Q is diagonal, in rising order: the one-sided derivatives of the sorted
  eigenvalues along this direction. They are not linear in the direction, for no linear derivative exists where the C of
  several variables do not commute. Else Q is fixed and general; reverse mode gives the mean of the diagonal of C for each, a
  subgradient in the sense of Clarke. dR = 0 within: the repeated modes move as a span.
- *Distinct eigenvalues nearer than `cluster`*: as above. Individual vectors are known to rounding / gap, their derivatives to
  rounding / gap^2, whatever the method: of K and M rounded to double precision more is not to be had (`ModeSeparation` gets
  that far). So a single vector is refused in reverse mode. Functions such as Psi g(Lambda) Psi' are exact to rounding /
  gap; nearer than NOISE that is not enough, and they are refused.

So at repeated eigenvalues these derivatives are exact in every mode: of symmetric functions of the eigenvalues alone (their
sum, the sum of their squares), and of functions of their span alone (Psi Psi'). **Functions of values and vectors together,
such as Psi g(Lambda) Psi'**, are exact in forward mode, for C is diagonal. In reverse mode all entries of C would enter: such
functions, and those of a single vector (whose dR is missing in forward mode), are recognized by their cotangents, and
refused by InputError. So is forward mode where the direction is not known when the modes are made, as under `jvp` of `vmap`,
if C is not diagonal. C of rigid motions, which no change of K stiffens, is zero but for rounding, and counts as zero.
`spectral_function` has these derivatives in every mode; so have functions of `modal_basis` with its
full Kr.

Along *one* direction individual modes have derivatives even here: `eigenpair_branches` finds them by Dailey's method.
**Separation of modes of near eigenvalues**, which rounding in the solver has mixed:

    G = Psi' K Psi,     H = Psi' M Psi       in extended precision, from the modes of the solver
    A = 1 - (H - 1) / 2 + Theta,     Theta_ij = (G_ij - (H - 1)_ij (lambda_i + lambda_j) / 2) / (lambda_j - lambda_i)

to first order A' H A = 1 and A' G A is diagonal; Theta is skew. The second order is that of rounding squared.

A solver mixes two modes at a gap g by about rounding / g, and their individual derivatives by rounding / g^2: 1e-12 and 1e-8 at
a relative gap of 1e-4, more where the norm of K is large. Psi A has what the numbers in K and M tell. What is left is
in these numbers: K rounded to double precision has modes that are mixed by the same order, and no method can undo it.
Derivatives of vectors, measured on matrices without rounding: 4e-10 at a relative gap of 6e-5, 6e-8 to 2e-7 at 8e-6, by
processor.
The span, hence every response, does not change: only individual modes do.

Pairs that are not `apart` stay as they are. Where the platform has no extended precision nothing is gained or lost.
A is a constant, from which the derivatives follow.
Source: Nelson, AIAA J. 14 (1976) 1201-1205; Dailey, AIAA J. 27 (1989) 486-491; Clarke, Optimization and Nonsmooth
Analysis (1983). Checked in tests/sensitivity/test_eigenpairs.py, tests/sensitivity/test_spectral.py,
tests/sensitivity/test_eigen_near_gaps.py.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual
from torch.func import debug_unwrap

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import CLUSTER, modal_basis, parse_pencil
from torchmbd.fem.reduction.cut import ROUNDING, rounding
from torchmbd.fem.reduction.forms import Diagonal, Form, Sparse
from torchmbd.fem.reduction.spectral import chained
from torchmbd.fem.reduction.transport import Pencil
from torchmbd.math.gradients import all_true
from torchmbd.math.sparse import SparseMatrix
from torchmbd.math.vmap import FirstDerivative, apply_as_lanes, batch_first

UNEQUAL = 1e-4  # of cotangents; less is what distinct eigenvalues of a cluster make of a symmetric function
NOISE = 1e-9  # relative gap at which rounding enters differences of functions of two eigenvalues by 2e-7
ASYMMETRY = 1e-13  # of cotangents of a span, by rounding
_REMEDY = (
    "functions of their values alone or of their span alone, spectral_function, modal_basis, eigenpair_branches along "
    "one direction"
)


class Eigenpairs(NamedTuple):
    """Eigenvalues [..., n], lowest first, and M-orthonormal vectors [..., N, n]."""

    values: Float[Tensor, "*lanes modes"]
    vectors: Float[Tensor, "*lanes freedoms modes"]


def eigenpairs(K: Tensor | SparseMatrix, M: Tensor | SparseMatrix, n: int, cluster: float = CLUSTER) -> Eigenpairs:
    """Find the n lowest modes of K psi = lambda M psi.

    K        dense [..., N, N] or SparseMatrix
    M        the same, or a vector [..., N], the diagonal of a lumped mass
    cluster  relative distance below which neighbors are one cluster, which n must not cut; see the module header

    Raises InputError for the same reasons as modal_basis. A backward pass through values and
    vectors that coincide, or through one of these vectors alone, raises it too.

    >>> K = torch.tensor([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]], dtype=torch.float64, requires_grad=True)
    >>> values, vectors = mbd.reduction.eigenpairs(K, torch.ones(3, dtype=torch.float64), 1)
    >>> values.sum().backward()
    >>> K.grad.round(decimals=3).tolist()  # psi psi'
    [[0.25, 0.354, 0.25], [0.354, 0.5, 0.354], [0.25, 0.354, 0.25]]
    """
    basis = modal_basis(K, M, n, cluster)
    pencil, K_values, M_values, lanes = parse_pencil(K, M, n)
    entries = pencil.K_form.diagonal(K_values) / pencil.M_form.diagonal(M_values)
    K_values, M_values, Kr, psi = (x.detach() for x in (K_values, M_values, *basis[::-1]))
    accuracy = rounding(pencil, K_values, M_values)
    values = Kr.diagonal(dim1=-2, dim2=-1).reshape(-1, n)
    apart = ~same_cluster(values, accuracy, cluster)
    turn = ModeSeparation.apply(pencil, K_values, M_values, psi.reshape(-1, *psi.shape[-2:]), apart).reshape(
        *lanes, n, n
    )
    stiffness, accuracy = turn.mT @ basis.stiffness @ turn, accuracy.reshape(lanes)
    values, R = _Split.apply(stiffness, _choice(stiffness, accuracy), accuracy, cluster, entries)
    return Eigenpairs(values, basis.vectors @ (turn @ R))


def _choice(stiffness: Tensor, accuracy: Tensor) -> Tensor:
    """Q [..., n, n] of repeated eigenvalues: the eigenvectors of C in forward mode, else a reflection in general position."""
    values = stiffness.diagonal(dim1=-2, dim2=-1).detach()
    repeated, eye = chained(values, accuracy[..., None]), torch.eye(values.shape[-1], dtype=values.dtype)
    if all_true(repeated == eye.bool()):
        return eye.expand(stiffness.shape)
    batched = debug_unwrap(stiffness, recurse=False).dim() != stiffness.dim()  # by a vmap that hides the tangent
    change = None if batched else unpack_dual(stiffness).tangent
    if change is not None:
        C = torch.where(repeated, change + change.mT, 0.0) / 2
        spread = 4.0 * C.abs().sum((-2, -1), keepdim=True) + 1.0  # keeps the blocks apart and in their order
        first = repeated.to(C.dtype).argmax(-1).to(C.dtype)
        return torch.linalg.eigh(C + torch.diag_embed(first) * spread).eigenvectors
    # Golden ratio: no two are equal.
    v = 0.2 + torch.frac(torch.arange(1, len(eye) + 1, dtype=values.dtype) * 0.6180339887)
    mirror = torch.where(repeated, v[:, None] * v, 0.0)
    size = repeated.to(v.dtype) @ v.square()[:, None]
    single = repeated.sum(-1, keepdim=True) == 1
    return torch.where(single, eye, eye - 2.0 * mirror / size)


def same_cluster(values: Tensor, accuracy: Tensor, cluster: float) -> Tensor:
    """Return which pairs of eigenvalues are in one cluster [..., n, n]."""
    return chained(values, torch.maximum(cluster * values[..., 1:].abs(), accuracy[..., None]))


class _Split(torch.autograd.Function):
    """Eigenvalues and eigenvectors R = Q of the reduced stiffness, which is diagonal at the design at hand.

    entries   K_ii / M_ii [..., N]: their change along a direction is the measure of rounding in that of the stiffness
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(Kr: Tensor, Q: Tensor, accuracy: Tensor, cluster: float, entries: Tensor) -> tuple[Tensor, Tensor]:
        return Kr.diagonal(dim1=-2, dim2=-1).clone(), Q.expand(Kr.shape).clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.cluster = inputs[3]
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(*output, inputs[2])
        ctx.save_for_backward(*output, inputs[2])

    @staticmethod
    def jvp(ctx: Any, dKr: Tensor, *others: Any) -> tuple[Tensor, Tensor]:
        values, Q, accuracy = ctx.saved_tensors
        C = Q.mT @ dKr @ Q
        noise = ROUNDING * others[-1].abs().amax(-1)
        C = C + _Refusal.apply(values, accuracy, ctx.cluster, None, C, noise)
        return C.diagonal(dim1=-2, dim2=-1).clone(), Q @ (C * _inverse_gaps(values, accuracy))

    @staticmethod
    def backward(ctx: Any, g: Tensor | None, G: Tensor | None) -> tuple[Tensor, None, None, None, None]:
        values, Q, accuracy = ctx.saved_tensors
        bar = torch.zeros_like(Q)
        if g is not None:
            repeated = chained(values, accuracy[..., None])
            share = repeated.to(g.dtype) / repeated.sum(-1, keepdim=True)
            bar = bar + torch.diag_embed((share @ g[..., None]).squeeze(-1))
        if G is not None:
            G = Q.mT @ G
            g = torch.zeros_like(values) if g is None else g
            turned = (G + _Refusal.apply(values, accuracy, ctx.cluster, g, G, None)) * _inverse_gaps(values, accuracy)
            bar = bar + (turned + turned.mT) / 2
        return Q @ bar @ Q.mT, None, None, None, None


class _Refusal(FirstDerivative):
    """Zeros [..., n, n], or the InputError of `_refuse`."""

    of = "modes"

    @staticmethod
    def forward(
        values: Tensor, accuracy: Tensor, cluster: float, g: Tensor | None, X: Tensor, noise: Tensor | None
    ) -> Tensor:
        return _refuse(values, accuracy, cluster, g, X, noise)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *arguments: Any) -> tuple:
        return _Refusal.apply(*_lanes_first(info.batch_size, in_dims, *arguments)), 0


@torch.library.custom_op("torchmbd::refuse_single_modes", mutates_args=())
def _refuse(
    values: Tensor, accuracy: Tensor, cluster: float, g: Tensor | None, X: Tensor, noise: Tensor | None
) -> Tensor:
    """Zeros [..., n, n]; InputError if derivatives of single modes were asked for that do not exist.

    g, X   cotangents of values [..., n] and of R [..., n, n], which must not tell one mode of a cluster from another: a
           function of a span has a symmetric block, one of its values alone has equal g. None, C: a direction, which
           must be diagonal where modes repeat, but for rounding: noise [...], of C
    It is an operator of torch, because batched tangents of torch.autograd cannot read numbers in Python functions.
    """
    noisy = same_cluster(values, accuracy, NOISE)
    if noise is not None:
        gaps = (values[..., None, :] - values[..., :, None]).abs()
        mixed = UNEQUAL + torch.where(
            chained(values, accuracy[..., None]), 0.0, accuracy[..., None, None] / 16.0 / gaps
        )
        beside = torch.where(noisy & ~torch.eye(values.shape[-1], dtype=torch.bool), X, 0.0).abs()
        size = X.abs().amax((-2, -1), keepdim=True)
        wrong = (beside > mixed * size + noise[..., None, None]).any(-1)
        near, what = noisy, "a derivative along a direction that turns them in their span"
    else:
        assert g is not None
        near = same_cluster(values, accuracy, cluster)
        size, asymmetry = X.abs().amax((-2, -1))[..., None], (X - X.mT).abs()
        turned = torch.where(near, asymmetry, 0.0).amax(-1) > UNEQUAL * size
        lost = torch.where(noisy, asymmetry, 0.0).amax(-1) > ASYMMETRY * size
        low, high = (torch.where(noisy, g[..., None, :], sign * torch.inf) for sign in (1, -1))
        unequal = high.amax(-1) - low.amin(-1) > UNEQUAL * g.abs().amax(-1, keepdim=True)
        inside = torch.where(noisy, X, 0.0).abs().amax(-1) > UNEQUAL * size
        wrong = turned | lost | (unequal & inside)
        what = "a gradient with respect to single vectors of them, or to values and vectors together"
    if wrong.any():
        lane, mode = (int(i) for i in wrong.reshape(-1, wrong.shape[-1]).nonzero()[0])
        labels = near.expand(*X.shape).reshape(-1, *near.shape[-2:])[lane, mode].nonzero().squeeze(-1) + 1
        modes = ", ".join(map(str, labels.tolist()))
        state = f"coincide, and eigenpairs do not have {what}"
        raise InputError("modes", labels.tolist(), hint=_REMEDY, noun=f"modes {modes}", state=state)
    return torch.zeros_like(X)


@_refuse.register_vmap
def _(info: Any, in_dims: tuple, *arguments: Any) -> tuple:
    return _refuse(*_lanes_first(info.batch_size, in_dims, *arguments)), 0


def _lanes_first(size: int, in_dims: tuple, *arguments: Any) -> list[Any]:
    """The arguments of `_refuse` with their batch in front."""
    pairs = zip(arguments, in_dims, strict=True)
    return [batch_first(x, dim, size) if isinstance(x, Tensor) else x for x, dim in pairs]


def _inverse_gaps(values: Tensor, accuracy: Tensor) -> Tensor:
    """1 / (lambda_i - lambda_j) at [j, i], zero where they are repeated."""
    same = chained(values, accuracy[..., None])
    gaps = values[..., None, :] - values[..., :, None]
    return torch.where(same, 0.0, 1 / torch.where(same, 1.0, gaps))


Array = np.ndarray


class ModeSeparation(torch.autograd.Function):
    """A [lane, n, n] from K, M [lane, *entry], Psi [lane, N, n] and `apart`, the pairs to separate [lane, n, n]."""

    @staticmethod
    def forward(pencil: Pencil, K: Tensor, M: Tensor, psi: Tensor, apart: Tensor) -> Tensor:
        result = torch.diag_embed(torch.ones_like(psi[:, 0]))
        if not apart.any():
            return result
        for lane, turn in enumerate(result):
            P = _extended(psi[lane])
            G, H = (P.T @ _times(form, x[lane], P) for form, x in ((pencil.K_form, K), (pencil.M_form, M)))
            turn.copy_(torch.from_numpy(_turn(G, H, apart[lane].cpu().numpy()).astype(np.float64)))
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        pass

    @staticmethod
    def vmap(info: Any, in_dims: tuple, pencil: Pencil, *tensors: Tensor) -> tuple[Tensor, int]:
        return apply_as_lanes(partial(ModeSeparation.apply, pencil), info, in_dims[1:], *tensors)


def _turn(G: Array, H: Array, apart: Array) -> Array:
    values, excess = G.diagonal() / H.diagonal(), H - np.eye(len(H))
    gaps = np.where(apart, values[None, :] - values[:, None], 1)
    mixed = G - excess * (values[None, :] + values[:, None]) / 2
    eye = np.eye(len(H))
    A = eye - excess / 2 + np.where(apart, (mixed + mixed.T) / 2 / gaps, 0)
    for _ in range(2):  # next to rounding Theta is no small turn: the sums over neighbors see whether A' H A = 1
        A = A @ (1.5 * eye - 0.5 * (A.T @ H @ A))
    return A


def _times(form: Form, values: Tensor, X: Array) -> Array:
    numbers = _extended(values)
    if isinstance(form, Diagonal):
        return numbers[:, None] * X
    if isinstance(form, Sparse):
        return csr_array((numbers, form.pattern.indices, form.pattern.indptr), shape=(form.size,) * 2) @ X
    return numbers @ X


def _extended(x: Tensor) -> Array:
    return x.detach().cpu().numpy().astype(np.longdouble)
