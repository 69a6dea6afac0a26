"""Craig-Bampton reduction: interface degrees of freedom kept, the interior moves by fixed-interface modes.

    x = T y,     T = | 1        0     |        K_oo Phi_o = M_oo Phi_o Lambda_o
                     | T_o      Phi_o |

y        interface degrees of freedom, then amplitudes of the n lowest fixed-interface modes       [m = i + n]
T_o      constraint modes, -K_oo^-1 K_oi (constraint_modes.py)

The equations of motion take bases that are orthonormal in M. Nothing but the span of T matters to them
(transport.py), so the basis may be chosen inside it. With all m modes of the small problem

    (T' K T) A = (T' M T) A Kr,     A' (T' M T) A = 1,      Psi = T A                                         (1)

Psi' M Psi = 1 and Psi' K Psi = Kr: the reduced mass is the identity as before, and Kr a full matrix that is diagonal at
the design at hand. Statics under interface loads stay exact, for T is in the span. By K T_c = 0 in the interior and Phi = 0 at
the interface, T' K T = diag(S, Lambda_o): no cancellation between the two families.

**Derivatives** are those of the composition, each part in its own right transport:

    T_o     one solve with the factor of K_oo, no gap at all
    Phi_o   modal_basis of the interior: only gaps to discarded fixed-interface modes
    A       modal_basis of (1) with all m modes: none is discarded, so no gap, dA = -1/2 A A' d(T' M T) A

dPsi = dT A + T dA has a part inside the span, the skew part of Psi' M dT A: it turns the basis in itself at a bounded
rate, and the derivative of Kr turns with it. Responses depend on the span alone and do not change by that. Crossings among
fixed-interface modes, among the modes of (1), or between both need no special case; a cluster of *fixed-interface*
modes is not cut (cut.py). Checked in tests/fem/reduction/test_craig_bampton.py, tests/sensitivity/test_eigen_craig_bampton.py.

Source: Craig and Bampton, AIAA J. 6 (1968) 1313-1319.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.basis import CLUSTER, Matrix, ModalBasis, fixed_modes, modal_basis
from torchmbd.fem.reduction.constraint_modes import constraint_modes, interface_freedoms, interior, interior_freedoms
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.gradients import untransformed
from torchmbd.math.sparse import SparseMatrix


def craig_bampton(
    K: Matrix,
    M: Matrix,
    n: int,
    interface: Sequence[int],
    cluster: float = CLUSTER,
    updated: bool = True,
    more: int = 0,
) -> ModalBasis:
    """Reduce to the interface degrees of freedom and the n lowest fixed-interface modes, or a few more.

    K, M, cluster, updated, more   as for modal_basis
    n                              number of fixed-interface modes; 0: static condensation
    interface                      rows of K, each once

    Raises InputError for the same reasons as modal_basis, and if the interface is empty, or K is singular with the interface
    held.

    >>> K = torch.tensor([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]], dtype=torch.float64)  # a free chain of three masses
    >>> basis = mbd.reduction.craig_bampton(K, torch.ones(3, dtype=torch.float64), n=1, interface=[0, 2])
    >>> basis.vectors.shape
    torch.Size([3, 3])
    """
    if not updated:
        return fixed_modes(K, M, lambda K, M: craig_bampton(K, M, n, interface, cluster, more=more))
    T, stiffness = constraint_modes(K, M, interface)
    size = T.shape[-2]
    held = interface_freedoms(interface, size)
    if not is_whole(n) or not 0 <= n <= size - len(held):
        raise InputError("n", n, f"0 to {size - len(held)}, the degrees of freedom that are not in the interface")
    if n:
        inner = modal_basis(interior(K, held, size), interior(M, held, size), n, cluster, more=more)
        width = inner.stiffness.shape[-1]
        Phi = inner.vectors.new_zeros(*inner.vectors.shape[:-2], size, width)
        Phi = Phi.index_copy(-2, interior_freedoms(held, size), inner.vectors)
        T = torch.cat([T, Phi], -1)
        pad = torch.nn.functional.pad
        stiffness = torch.cat([pad(stiffness, (0, width)), pad(inner.stiffness, (len(held), 0))], -2)
    mass = T.mT @ times(M, T)
    return small_basis(T, stiffness, (mass + mass.mT) / 2)


def small_basis(T: Tensor, stiffness: Tensor, mass: Tensor) -> ModalBasis:
    """Return the basis of the span of T [..., N, m] by (1); stiffness T' K T and mass T' M T.

    Columns of T may be padding, of lanes with fewer modes; it is zero in the basis too. Padding has unit mass and a frequency
    above all others, so that its modes are the last ones of the small problem, alone.
    """
    padding = (T.detach() == 0.0).all(-2)  # of each member, also under torch.func.vmap
    if not bool(untransformed(padding).any()):
        small = modal_basis(stiffness, mass, T.shape[-1])
        return ModalBasis(T @ small.vectors, small.stiffness)
    unit = torch.diag_embed(padding.to(T.dtype))
    highest = (
        torch.linalg.solve(mass.detach() + unit, stiffness.detach()).diagonal(dim1=-2, dim2=-1).sum(-1)
    )  # the trace is above
    small = modal_basis(stiffness + 2.0 * highest[..., None, None] * unit, mass + unit, T.shape[-1])
    kept = torch.arange(T.shape[-1]) < (~padding).sum(-1, keepdim=True)
    vectors = torch.where(kept[..., None, :], small.vectors, 0.0)
    both = kept[..., None, :] & kept[..., :, None]
    return ModalBasis(T @ vectors, torch.where(both, small.stiffness, 0.0))


def times(M: Matrix, X: Tensor) -> Tensor:
    """M X [..., N, k]."""
    if isinstance(M, SparseMatrix):
        return M @ X
    return M @ X if M.dim() > 1 and M.shape[-2] == X.shape[-2] else M[..., None] * X
