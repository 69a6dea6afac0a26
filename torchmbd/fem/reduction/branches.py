"""Individual modes along one direction of the design space, also where eigenvalues repeat: Dailey's method.

K and M are analytic along a line b + t d through a design. Then so are eigenvalues and modes, with the right basis within
each cluster (Rellich). This basis is found order by order:

1. `retained_series` gives Kr(t) = Kr_0 + t Kr_1 + t^2 Kr_2 + ... of the retained span.
2. A cluster of Kr_0 is again a span that moves: the same series inside the n x n problem gives its block
   B(t) = lambda 1 + t B_1 + t^2 B_2 + ...
3. (B(t) - lambda) / t = B_1 + t B_2 + ... is a problem of the same kind. Its eigenvalues are the slopes of the branches,
   its eigenvectors the right basis. Where slopes are equal it has clusters itself, to which 2. and 3. apply again: the
   second derivative splits what the first does not, and so on.

A basis that is split by the derivative of order s moves at a rate that needs the derivative of order s + 1: so K''
(here by torch.func.jvp of jvp) enters already where K' splits the cluster, as in Dailey's paper. What the available
orders do not split is repeated along the line as far as can be seen: any basis of it is a right one, and it moves as
a span. With several design variables each has its own right basis; they agree only where the cluster's matrices
commute, and then one direction that splits the cluster gives it. Nothing else can be differentiated individually.

The series of the retained span along the line:

    K(t) Psi(t) = M(t) Psi(t) Kr(t),     Psi(t)' M(t) Psi(t) = 1,     X(t) = X_0 + t X_1 + t^2 X_2 + ...

With Psi_m = Psi_0 S_m + Z_m, Psi_0' M_0 Z_m = 0, the terms of order t^m give, as transport.py does for m = 1,

    N_m  = sum_{a+b+c = m; b, c < m} Psi_c' M_a Psi_b            S_m = -N_m / 2, symmetric
    F_m  = sum_{a+b = m; b < m} K_a Psi_b  -  sum_{a+b+c = m; b, c < m} M_a Psi_b Kr_c
    Kr_m = Psi_0' F_m + Kr_0 S_m - S_m Kr_0
    (K_0 - lambda_i M_0) z_m,i = -P f_m,i

Every order needs one more deflated solve with the factorization of the first; only gaps to discarded modes appear at
any order. No autograd inside.
Source: Dailey, AIAA J. 27 (1989) 486-491; Kato, Perturbation Theory for Linear Operators, section II.2 (reduction
process). Checked in tests/sensitivity/test_eigenpair_branches.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import CLUSTER, Matrix, parse_pencil, signs, solve
from torchmbd.fem.reduction.cut import rounding
from torchmbd.fem.reduction.eigenpairs import ModeSeparation, same_cluster
from torchmbd.fem.reduction.forms import Dense, Diagonal
from torchmbd.fem.reduction.transport import Pencil
from torchmbd.math.forward_mode import jvp

UNSPLIT = -1


class Branches(NamedTuple):
    """Modes along a line, lowest eigenvalue first, in a cluster lowest slope first.

    split: the order of the derivative that separates a mode from its neighbors: 0 distinct, 1, 2, ...; -1 not
    separated.
    """

    values: Float[Tensor, " modes"]
    vectors: Float[Tensor, "freedoms modes"]
    value_slopes: Float[Tensor, " modes"]
    vector_slopes: Float[Tensor, "freedoms modes"]
    split: Int[Tensor, " modes"]


def eigenpair_branches(
    matrices: Callable[[Tensor], tuple[Matrix, Matrix]],
    b: Float[Tensor, " variables"],
    direction: Float[Tensor, " variables"],
    n: int,
    cluster: float = CLUSTER,
    orders: int = 3,
) -> Branches:
    """Differentiate the n lowest modes at b along a direction.

    matrices  from a design vector to K and M (forms as for modal_basis), in operations that torch.func.jvp can nest
    cluster   relative distance below which eigenvalues, and then their slopes, count as equal; n must not cut a cluster
    orders    number of derivatives of K and M that are used; derivatives up to the order `orders` - 1 can split a cluster

    Raises InputError for the same reasons as modal_basis, and if orders is smaller than 1.

    >>> def matrices(b):  # two modes of equal frequency at b = 0
    ...     return torch.diag(torch.stack([1.0 + b[0], 1.0 - b[0]])), torch.ones(2, dtype=torch.float64)
    >>> b, direction = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    >>> mbd.reduction.eigenpair_branches(matrices, b, direction, 2).value_slopes.tolist()
    [-1.0, 1.0]
    """
    if orders < 1:
        raise InputError("orders", orders, "at least 1")
    pencil, K, M, lanes = parse_pencil(*matrices(b), n)
    if lanes:
        raise InputError(
            "matrices", allowed="must have one design at a time", state=f"has lanes {tuple(lanes)}", noun="matrices(b)"
        )

    def along(t: Tensor) -> tuple[Tensor, Tensor]:
        _, K, M, _ = parse_pencil(*matrices(b + t * direction), n)
        return K, M

    values, psi = solve(pencil, n, K, M, cluster)
    psi = psi @ ModeSeparation.apply(pencil, K, M, psi, ~same_cluster(values, rounding(pencil, K, M), cluster))
    series = taylor(along, orders)
    Psi, Kr = retained_series(pencil, values, psi, [K for K, _ in series], [M for _, M in series])
    branches = sorted(_split(Kr, cluster, values.abs().max().item(), 0), key=lambda branch: branch.order)
    gamma = [torch.stack([branch.vector[m] for branch in branches], dim=1) for m in (0, 1)]
    sign = signs(Psi[0] @ gamma[0])
    return Branches(
        values=torch.stack([branch.value[0] for branch in branches]),
        vectors=Psi[0] @ gamma[0] * sign,
        value_slopes=torch.stack([branch.value[1] for branch in branches]),
        vector_slopes=(Psi[1] @ gamma[0] + Psi[0] @ gamma[1]) * sign,
        split=torch.tensor([branch.split for branch in branches]),
    )


def taylor(function: Callable[[Tensor], tuple[Tensor, Tensor]], orders: int) -> list[tuple[Tensor, Tensor]]:
    """Return the Taylor coefficients at zero of a pair of tensors that depend on a scalar, orders 0 to `orders`."""
    zero, unit = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    coefficients = []
    for m in range(orders + 1):
        first, second = function(zero)
        coefficients.append((first / math.factorial(m), second / math.factorial(m)))
        function = _derivative(function, unit)
    return coefficients


def _derivative(function: Callable, unit: Tensor) -> Callable:
    return lambda t: jvp(function, (t,), (unit,))[1]


class _Branch(NamedTuple):
    """Series of an eigenvalue and its vector, the order that split it, and its ranks among eigenvalues, slopes, ..."""

    value: list[Tensor]
    vector: list[Tensor]
    split: int
    order: tuple[int, ...]


def _split(A: list[Tensor], cluster: float, scale: float, depth: int) -> list[_Branch]:
    """Return the branches of the symmetric matrix A_0 + t A_1 + ...; `scale`: size to which distances are relative."""
    values, Q = torch.linalg.eigh((A[0] + A[0].T) / 2)
    A = [Q.T @ a @ Q for a in A]
    tolerance = cluster * max(scale, values.abs().max().item())
    labels = torch.nn.functional.pad((values.diff() > tolerance).cumsum(0), (1, 0))
    branches = []
    for label in range(int(labels[-1]) + 1):
        U, B = _cluster_series(A, values, labels == label)
        branches += [
            branch._replace(vector=[Q @ v for v in branch.vector], order=(label, *branch.order))
            for branch in _cluster_branches(U, B, cluster, scale, depth)
        ]
    return branches


def _cluster_branches(U: list[Tensor], B: list[Tensor], cluster: float, scale: float, depth: int) -> list[_Branch]:
    """Branches of one cluster, whose span is U(t) and whose block is B(t)."""
    size = len(B[0])
    if size == 1:
        return [_Branch([b[0, 0] for b in B], [u[:, 0] for u in U], depth, (0,))]
    if len(B) < 3:  # dividing by t would leave no derivative of the vectors
        return [_Branch([b[i, i] for b in B], [u[:, i] for u in U], UNSPLIT, (i,)) for i in range(size)]
    branches = []
    for inner in _split(B[1:], cluster, scale, depth + 1):
        known = len(inner.vector)
        vector = [
            sum((U[m - k] @ inner.vector[k] for k in range(m + 1)), torch.zeros_like(U[0][:, 0])) for m in range(known)
        ]
        at_zero = inner.vector[0] @ B[0] @ inner.vector[0]
        branches.append(_Branch([at_zero, *inner.value], vector, inner.split, inner.order))
    return branches


class _DiagonalSolver:
    """Deflated solves of a diagonal problem for chosen eigenvalues, which need not be the lowest."""

    def __init__(self, values: Tensor, chosen: Tensor) -> None:
        gaps = values[:, None] - values[chosen]
        self.weight = torch.where(chosen[:, None], 0.0, 1 / torch.where(chosen[:, None], 1.0, gaps))

    def deflated_solve(self, F: Tensor) -> Tensor:
        return F * self.weight[None, :, None, :]


def _cluster_series(A: list[Tensor], values: Tensor, chosen: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Return the series of the span of the chosen eigenvectors of the diagonal A_0, and of its block."""
    n = len(values)
    pencil = Pencil(Dense(n), Diagonal(n))
    pencil.modes = _DiagonalSolver(values, chosen)
    identity = [torch.full((1, n), float(m == 0), dtype=values.dtype) for m in range(len(A))]
    start = torch.eye(n, dtype=values.dtype)[None, :, chosen]
    return retained_series(pencil, values[None, chosen], start, [a[None] for a in A], identity)


def retained_series(
    pencil: Pencil, values: Tensor, psi: Tensor, K: list[Tensor], M: list[Tensor]
) -> tuple[list[Tensor], list[Tensor]]:
    """Psi_m [N, n] and Kr_m [n, n] from the Taylor coefficients of the values of K and M, all with one lane [1, ...].

    `values`, `psi`: eigenvalues [1, n] and vectors [1, N, n] at t = 0, for which `pencil` has been solved.
    """
    Psi, Kr = [psi], [torch.diag_embed(values)]
    for m in range(1, len(K)):
        M_Psi = [[pencil.M_form.multiply(M[a], Psi[b]) for b in range(m)] for a in range(m + 1)]
        terms = [(a, b, m - a - b) for a in range(m + 1) for b in range(m) if 0 <= m - a - b < m]
        N, F = torch.zeros_like(Kr[0]), torch.zeros_like(psi)
        for a, b, c in terms:
            N += Psi[c].mT @ M_Psi[a][b]
            F -= M_Psi[a][b] @ Kr[c]
        for b in range(m):
            F += pencil.K_form.multiply(K[m - b], Psi[b])
        S = -N / 2  # the sum is symmetric: with each product it holds its transpose
        Kr.append(psi.mT @ F + Kr[0] @ S - S @ Kr[0])
        Z = -pencil.modes.deflated_solve(F[:, :, None, :])[:, :, 0, :]
        Psi.append(psi @ S + Z)
    return [p[0] for p in Psi], [k[0] for k in Kr]
