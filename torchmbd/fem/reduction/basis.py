"""The modal basis that the motion uses: the retained modes, and the reduced stiffness as a full matrix.

    K Psi = M Psi Kr,     Psi' M Psi = 1,     Kr = Psi' K Psi

K, M     stiffness and mass of all degrees of freedom        [..., N, N]
Psi      the n lowest modes                        [..., N, n]
Kr       reduced stiffness                         [..., n, n]

Only the retained *subspace* enters a motion; transport.py derives the derivative that follows from this, and why
eigenvalues may cross or repeat inside the retained set. The one gap that matters is the gap to the first discarded
mode. A cluster of eigenvalues is therefore never cut there: a lane has n modes, or up to `more` further ones by the rule of
cut.py, or InputError is raised. Lanes with fewer modes than others are padded: zero columns of Psi, and zeros in Kr.

The sign of a mode, which the eigenproblem leaves open:

    c' psi > 0,      c_k = exp(-DECAY k / N),      k = 0 ... N - 1 the degrees of freedom in their order

c depends on N alone, so the sign of a mode depends neither on the solver nor on the batch; and c' psi is linear: a small change
of the design changes a sign only where psi is nearly orthogonal to c, never because two components are equally large. Nodes
are numbered along a body, so c falls along it: neither symmetric nor antisymmetric modes are orthogonal to it. Every rule has
designs where signs change, because along a closed path of designs a mode may come back with the other sign. Between
neighboring designs, over random stacks of plates, a rule by the largest component changes signs 2 to 70 times as often as
this one, a random c 2 to 3 times as often.

Differentiable once, forward and reverse, under vmap and jacfwd, in the values of K and M. All directions share one
factorization. Assumed: K symmetric (it may be singular: a free body), M symmetric and positive definite, and so are
their derivatives symmetric. Source: section 4.2 and eqs. (34)-(36) of the paper; design notes of transport.py.
Checked in tests/fem/reduction/test_modal_basis.py, tests/fem/reduction/test_signs.py and
tests/sensitivity/test_eigen_subspace.py.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.cut import cut_error, cut_modes
from torchmbd.fem.reduction.forms import check, check_positive_diagonal, recognize
from torchmbd.fem.reduction.operator_call import ModeDerivative
from torchmbd.fem.reduction.shared_modes import apply_rule, shared_modes
from torchmbd.fem.reduction.transport import Pencil, cotangent, tangent
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.sparse import SparseMatrix
from torchmbd.math.vmap import apply_as_lanes

Matrix = Tensor | SparseMatrix
CLUSTER = 1e-6
DECAY = 1.7  # of c, the rule of signs


class ModalBasis(NamedTuple):
    """M-orthonormal modes [..., N, n] and the reduced stiffness [..., n, n]; see the header."""

    vectors: Float[Tensor, "*lanes freedoms modes"]
    stiffness: Float[Tensor, "*lanes modes modes"]


def signs(vectors: Tensor) -> Tensor:
    """Return the factors 1 or -1 [..., 1, n] that give vectors [..., N, n] their signs."""
    size = vectors.shape[-2]
    share = torch.arange(size, dtype=vectors.dtype) / size
    along = torch.exp(-DECAY * share) @ vectors
    return torch.where(along < 0, -torch.ones_like(along), 1.0).unsqueeze(-2)


def modal_basis(
    K: Matrix, M: Matrix, n: int, cluster: float = CLUSTER, updated: bool = True, more: int = 0
) -> ModalBasis:
    """Reduce to the n lowest modes, or a few more.

    K        dense [..., N, N] or SparseMatrix; leading lanes broadcast
    M        the same, or a vector [..., N], the diagonal of a lumped mass
    cluster  smallest accepted gap to the first discarded mode, relative to its eigenvalue
    updated  True: derivatives of the modes are part of all derivatives; False: modes are held fixed and only Kr has a
             derivative, Psi' dK Psi (eq. 36; for comparison, it is wrong in general)
    more     number of further modes that a lane may retain, so that the gap to the discarded modes is wide (cut.py); lanes
             with fewer modes are padded with zeros

    Raises InputError if entries are not finite, K or M is not symmetric, M is not positive definite, or n is out of range.
    Raises CutCluster, an InputError with the lanes, if n separates modes of equal frequency.

    >>> K = torch.tensor([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]], dtype=torch.float64)  # three masses in a chain
    >>> basis = mbd.reduction.modal_basis(K, torch.ones(3, dtype=torch.float64), 2)
    >>> basis.vectors.shape, basis.stiffness.diagonal().round(decimals=4).tolist()  # 2 - sqrt(2), 2
    (torch.Size([3, 2]), [0.5858, 2.0])
    """
    if not updated:
        return fixed_modes(K, M, lambda K, M: modal_basis(K, M, n, cluster, more=more))
    pencil, K_values, M_values, lanes = parse_pencil(K, M, n)
    vectors, stiffness = _Basis.apply(pencil, (n, more, cluster), K_values, M_values)
    return ModalBasis(*(x.reshape(*lanes, *x.shape[1:]) for x in (vectors, stiffness)))


def fixed_modes(K: Matrix, M: Matrix, reduce: Callable[[Matrix, Matrix], ModalBasis]) -> ModalBasis:
    """Return the basis of `reduce` without derivatives of the modes: only Kr has one, Psi' dK Psi (eq. 36)."""
    with torch.no_grad():
        vectors = reduce(_detached(K), _detached(M)).vectors
    return ModalBasis(vectors, vectors.mT @ (K @ vectors))


def _detached(matrix: Matrix) -> Matrix:
    return (
        SparseMatrix(matrix.pattern, matrix.values.detach(), matrix.symmetric)
        if isinstance(matrix, SparseMatrix)
        else matrix.detach()
    )


def parse_pencil(K: Matrix, M: Matrix, n: int) -> tuple[Pencil, Tensor, Tensor, tuple[int, ...]]:
    """Return the forms and values of K and M with all leading dimensions flattened to one, and these dimensions."""
    K_form, K_values = recognize("K", K)
    M_form, M_values = recognize("M", M, K_form.size)
    if not is_whole(n) or not 1 <= n <= K_form.size:
        raise InputError(
            "n",
            n,
            f"1 to {K_form.size}, the degrees of freedom of the problem",
        )
    K_lanes, M_lanes = K_values.shape[: -K_form.entry_dims], M_values.shape[: -M_form.entry_dims]
    try:
        lanes = np.broadcast_shapes(K_lanes, M_lanes)
    except ValueError:
        raise InputError(
            "M",
            allowed="must have lanes that broadcast",
            state=f"has lanes {tuple(M_lanes)}, and K has {tuple(K_lanes)}",
        ) from None
    K_entry, M_entry = K_values.shape[len(K_lanes) :], M_values.shape[len(M_lanes) :]
    flat_K = K_values.expand(*lanes, *K_entry).reshape(-1, *K_entry)
    flat_M = M_values.expand(*lanes, *M_entry).reshape(-1, *M_entry)
    return Pencil(K_form, M_form), flat_K, flat_M, lanes


def solve(pencil: Pencil, n: int, K: Tensor, M: Tensor, cluster: float, more: int = 0) -> tuple[Tensor, Tensor]:
    """Return the eigenvalues [lane, m] and vectors [lane, N, m] that are retained; m is the largest number of a lane.

    InputError for bad values, CutCluster for a cut cluster.
    """
    check("K", pencil.K_form, K)
    check("M", pencil.M_form, M)
    check_positive_diagonal(pencil.M_form, M)
    pencil.modes = modes = shared_modes(K, M, partial(cut_modes, pencil, n, more, cluster))
    if not modes.counts.all():
        raise cut_error(pencil, modes, n, more, cluster, K, M)
    values, vectors = modes.lowest()
    most = vectors.shape[2]
    return torch.where(torch.arange(most) < modes.counts[:, None], values[:, :most], 0.0), vectors * signs(vectors)


class _Basis(torch.autograd.Function):
    """Psi [lane, N, m] and Kr [lane, m, m]; derivatives through transport.py. `cut`: n, more, cluster."""

    @staticmethod
    def forward(pencil: Pencil, cut: tuple[int, int, float], K: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
        n, more, cluster = cut
        values, vectors = solve(pencil, n, K, M, cluster, more)
        return vectors, torch.diag_embed(values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.pencil = inputs[0]
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(*output)
        ctx.save_for_backward(*output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, pencil: Pencil, cut: tuple[int, int, float], K: Tensor, M: Tensor) -> tuple:
        return apply_as_lanes(partial(_Basis.apply, pencil, cut), info, in_dims[2:], K, M)

    @staticmethod
    def jvp(ctx: Any, _pencil: Any, _cut: Any, dK: Tensor | None, dM: Tensor | None) -> Any:
        vectors, stiffness = ctx.saved_tensors
        values = stiffness.diagonal(dim1=-2, dim2=-1)
        dK, dM = (None if d is None else d.unsqueeze(1) for d in (dK, dM))
        dPsi, dKr = ModeDerivative.apply(partial(apply_rule, tangent, ctx.pencil), 2, values, vectors, dK, dM)
        return dPsi.squeeze(1), dKr.squeeze(1)

    @staticmethod
    def backward(ctx: Any, G: Tensor | None, H: Tensor | None) -> Any:
        vectors, stiffness = ctx.saved_tensors
        values = stiffness.diagonal(dim1=-2, dim2=-1)
        G = torch.zeros_like(vectors) if G is None else G
        H = torch.zeros_like(stiffness) if H is None else H
        directions = G.unsqueeze(1), H.unsqueeze(1)
        K_bar, M_bar = ModeDerivative.apply(partial(apply_rule, cotangent, ctx.pencil), 2, values, vectors, *directions)
        return None, None, K_bar.squeeze(1), M_bar.squeeze(1)
