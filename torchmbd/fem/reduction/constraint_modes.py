"""Constraint modes: static displacements where one interface degree of freedom is one and all others are zero.

    K = | K_ii  K_io |        T = |         1        |        S = T' K T = K_ii - K_io K_oo^-1 K_oi
        | K_oi  K_oo |            | -K_oo^-1 K_oi    |

i, o     interface and interior degrees of freedom
T        constraint modes                           [..., N, i]
S        stiffness condensed to the interface       [..., i, i]

K T has no interior rows, so a change of T in its interior rows does no work on it:

    dT_o = -K_oo^-1 (dK T)_o,      dS = T' dK T                                                            (1)

Reverse mode is the transpose. For cotangents G of T and H of S, with Y_o = K_oo^-1 G_o and Y_i = 0,

    <G, dT> + <H, dS> = <(T H - Y) T', dK>                                                                 (2)

Differentiable once in the values of K, forward and reverse, under vmap and jacfwd; one factorization of K_oo serves all.
Assumed: K symmetric, K_oo positive definite. Source: Craig and Bampton, AIAA J. 6 (1968) 1313-1319; (1), (2) derived here.
Checked in tests/fem/reduction/test_craig_bampton.py and tests/sensitivity/test_eigen_craig_bampton.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import Matrix, parse_pencil
from torchmbd.fem.reduction.elimination import Solver
from torchmbd.fem.reduction.forms import Dense, Sparse, check, check_positive_diagonal
from torchmbd.fem.reduction.operator_call import ModeDerivative
from torchmbd.fem.reduction.transport import Pencil
from torchmbd.math.checked_numbers import indices
from torchmbd.math.module_call import outside_transforms
from torchmbd.math.sparse import Pattern, SparseMatrix
from torchmbd.math.vmap import apply_as_lanes


def constraint_modes(K: Matrix, M: Matrix, interface: Sequence[int]) -> tuple[Tensor, Tensor]:
    """T [..., N, i] and S [..., i, i] of the interface degrees of freedom, in their order.

    M is only checked, so that messages name its rows in the whole matrix. Raises InputError: entries not finite, K or M not
    symmetric, a diagonal entry of M not positive, interface degrees of freedom out of range or repeated, K_oo not positive
    definite.
    """
    pencil, K_values, M_values, lanes = parse_pencil(K, M, 1)
    size = pencil.K_form.size
    split = Split(pencil, interface_freedoms(interface, size))
    T, S = _ConstraintModes.apply(split, K_values, M_values)
    return T.reshape(*lanes, *T.shape[1:]), S.reshape(*lanes, *S.shape[1:])


def interface_freedoms(interface: Sequence[int], size: int) -> tuple[int, ...]:
    """Interface degrees of freedom as integers; InputError if they are out of range, repeated, none or all."""
    freedoms = tuple(indices("interface", list(interface)).tolist())
    for i in freedoms:
        if not 0 <= i < size:
            raise InputError(
                "interface",
                interface,
                f"must have degrees of freedom from 0 to {size - 1}",
                state=f"has the degree of freedom {i}",
            )
        if freedoms.count(i) > 1:
            raise InputError("interface", interface, "must have each at most once", state=f"has {i} more than once")
    if not 0 < len(freedoms) < size:
        raise InputError(
            "interface",
            interface,
            "must have at least one, and not all",
            state=f"has {len(freedoms)} of {size} degrees of freedom",
        )
    return freedoms


@lru_cache(maxsize=64)
def interior_freedoms(interface: tuple[int, ...], size: int) -> Tensor:
    """The other degrees of freedom, in rising order."""

    def others() -> Tensor:
        held = torch.zeros(size, dtype=torch.bool)
        held[list(interface)] = True
        return (~held).nonzero().squeeze(-1)

    return outside_transforms(others)  # it is kept, and a tensor of a transform must not outlive it


@lru_cache(maxsize=64)
def _restricted(pattern: Pattern, interface: tuple[int, ...]) -> tuple[Pattern, Tensor]:
    return outside_transforms(lambda: pattern.restrict(interior_freedoms(interface, pattern.size)))


def interior(matrix: Matrix, interface: tuple[int, ...], size: int) -> Matrix:
    """The interior rows and columns of a matrix in any form that modal_basis takes."""
    if isinstance(matrix, SparseMatrix):
        pattern, positions = _restricted(matrix.pattern, interface)
        return SparseMatrix(pattern, matrix.values[..., positions])
    keep = interior_freedoms(interface, size)
    diagonal = matrix.dim() == 1 or matrix.shape[-2] != size
    return matrix[..., keep] if diagonal else matrix[..., keep, :][..., keep]


class Split:
    """The form of K and its interior degrees of freedom; and, after `factorize`, the factor of K_oo."""

    def __init__(self, pencil: Pencil, interface: tuple[int, ...]) -> None:
        self.pencil, self.interface = pencil, interface
        self.interior = interior_freedoms(interface, pencil.K_form.size)

    def factorize(self, K: Tensor) -> None:
        if isinstance(self.pencil.K_form, Sparse):
            pattern, positions = _restricted(self.pencil.K_form.pattern, self.interface)
            self.solver, values = Solver(Sparse(pattern), freedoms=self.interior), K[:, positions]
        else:
            values = K[:, self.interior][:, :, self.interior]
            self.solver = Solver(Dense(len(self.interior)), freedoms=self.interior)
        self.solver.factorize(values, "with the interface held lets the rest move")

    def solve(self, F: Tensor) -> Tensor:
        """K_oo^-1 F_o for columns F [lane, T, N, k], with zeros in the interface rows."""
        solved = self.solver.solve(F[:, :, self.interior])
        return torch.zeros_like(F).index_copy(2, self.interior, solved)


class _ConstraintModes(torch.autograd.Function):
    """T [lane, N, i] and S [lane, i, i]."""

    @staticmethod
    def forward(split: Split, K: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
        pencil = split.pencil
        check("K", pencil.K_form, K)
        check("M", pencil.M_form, M)
        check_positive_diagonal(pencil.M_form, M)
        split.factorize(K)
        held = list(split.interface)
        unit = K.new_zeros(len(K), 1, pencil.K_form.size, len(held))
        unit[:, :, held, range(len(held))] = 1.0
        T = unit - split.solve(pencil.K_form.multiply(K[:, None], unit))
        S = pencil.K_form.multiply(K, T[:, 0])[:, held]
        return T[:, 0], (S + S.mT) / 2

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.split = inputs[0]
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(output[0])
        ctx.save_for_backward(output[0])

    @staticmethod
    def vmap(info: Any, in_dims: tuple, split: Split, K: Tensor, M: Tensor) -> tuple:
        return apply_as_lanes(partial(_ConstraintModes.apply, split), info, in_dims[1:], K, M)

    @staticmethod
    def jvp(ctx: Any, _split: Any, dK: Tensor | None, _dM: Any) -> Any:
        (T,) = ctx.saved_tensors
        if dK is None:
            return torch.zeros_like(T), T.new_zeros(len(T), T.shape[-1], T.shape[-1])
        dT, dS = ModeDerivative.apply(partial(_tangent, ctx.split), 1, T, dK.unsqueeze(1))
        return dT.squeeze(1), dS.squeeze(1)

    @staticmethod
    def backward(ctx: Any, G: Tensor | None, H: Tensor | None) -> Any:
        (T,) = ctx.saved_tensors
        columns = torch.zeros_like(T) if G is None else G
        small = torch.zeros_like(T[:, : T.shape[-1]]) if H is None else H
        K_bar, _ = ModeDerivative.apply(partial(_cotangent, ctx.split), 1, T, columns.unsqueeze(1), small.unsqueeze(1))
        return None, K_bar.squeeze(1), None


def _tangent(split: Split, T: Tensor, dK: Tensor) -> tuple[Tensor, Tensor]:
    """dT [lane, T, N, i] and dS [lane, T, i, i] from dK [lane, T, *entry] by (1)."""
    F = split.pencil.K_form.multiply(dK, T[:, None])
    return -split.solve(F), T.mT[:, None] @ F


def _cotangent(split: Split, T: Tensor, G: Tensor, H: Tensor) -> tuple[Tensor, Tensor]:
    """The cotangent of K [lane, T, *entry] from those of T [lane, T, N, i] and S [lane, T, i, i] by (2), and nothing."""
    columns = T[:, None]
    return split.pencil.K_form.pair(columns @ H - split.solve(G), columns), T.new_zeros(*G.shape[:2], 0)
