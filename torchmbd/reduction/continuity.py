"""Order and sign of modes that follow the design, by modal assurance: for plots and modal coordinates over iterations.

    MAC_ij = (psi_i' M phi_j)^2,      psi of the previous design, phi of the current one, both M-orthonormal

Solvers return modes by rising eigenvalue and with any sign, so curves jump where eigenvalues cross. The motion does not
care (transport.py); a plot does. The assignment with the largest total MAC keeps each mode at its place; within a
repeated eigenvalue, where modes may be turned at will, `span` turns the whole set as close to the previous one as
possible. Not differentiable: it chooses among modes and does not move them. Source: Allemang, Sound and Vibration 37
(2003) 14-21; Schoenemann, Psychometrika 31 (1966) 1-10 (orthogonal Procrustes). Checked in
tests/reduction/test_continuity.py.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from torchmbd.errors import InputError


class Alignment(NamedTuple):
    """Current modes in the order and with the signs of the previous ones: `vectors = current[:, order] * sign`.

    assurance: MAC of each mode with its forerunner, from 0 (another shape) to 1 (the same).
    """

    vectors: Float[Tensor, "freedoms modes"]
    order: Int[Tensor, " modes"]
    sign: Float[Tensor, " modes"]
    assurance: Float[Tensor, " modes"]


def align(
    previous: Float[Tensor, "freedoms modes"],
    current: Float[Tensor, "freedoms modes"],
    mass: Float[Tensor, " freedoms"],
) -> Alignment:
    """Order and sign the current modes as the previous ones; `mass`: the diagonal of M. Raises InputError on shapes."""
    overlap = _overlap(previous, current, mass)
    _, columns = linear_sum_assignment((overlap**2).numpy(), maximize=True)
    order = torch.from_numpy(columns)
    matched = overlap[torch.arange(len(order)), order]
    sign = torch.where(matched < 0, -1.0, 1.0).to(current.dtype)
    return Alignment(current[:, order] * sign, order, sign, matched**2)


def span(
    previous: Float[Tensor, "freedoms modes"],
    current: Float[Tensor, "freedoms modes"],
    mass: Float[Tensor, " freedoms"],
) -> Float[Tensor, "modes modes"]:
    """The rotation R that brings `current @ R` closest to `previous`; modal coordinates become R' w, Kr R' Kr R."""
    left, _, right = torch.linalg.svd(_overlap(previous, current, mass))
    return (left @ right).mT


def _overlap(previous: Tensor, current: Tensor, mass: Tensor) -> Tensor:
    if previous.shape != current.shape or mass.shape != previous.shape[:1]:
        shapes = f"{tuple(previous.shape)}, {tuple(current.shape)}, {tuple(mass.shape)}"
        raise InputError(f"previous, current, mass have shapes {shapes}; [N, n], [N, n], [N] are needed")
    return previous.detach().mT @ (mass.detach()[:, None] * current.detach())
