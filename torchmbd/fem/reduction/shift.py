"""A shift sigma below the spectrum, so that K - sigma M has a Cholesky factorization even when K is singular.

sigma = 0 where K is safely positive definite. Otherwise (a free body: rigid-body modes; or K indefinite) sigma < 0 is
multiplied by ten, from a tiny part of the highest frequency, until all pivots are well above rounding. Each lane has its own
sigma; results of the reduction do not depend on it.
This first sigma is so near to zero that K - sigma M loses digits. So once the eigenvalues are roughly known, it is replaced by
one of their size; and so is sigma = 0 where K has modes near zero that its pivots did not show.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.reduction.forms import lane_name

Factor = TypeVar("Factor")

SAFE_PIVOT = 1e-12  # relative to the diagonal entry; rounding leaves about 1e-15 where the exact pivot is zero
LOST = 1e6  # ratio of the largest mu to the smallest that is wanted
FIRST_SHIFT = 1e-10  # relative to the largest K_ii / M_ii


def choose_shift(
    K_diagonal: Tensor, M_diagonal: Tensor, factorize: Callable[[Tensor], tuple[Factor, Tensor]]
) -> tuple[Tensor, Factor]:
    """Find sigma [lane] and the factor of K - sigma M.

    `factorize(sigma)` returns the factor and each lane's smallest pivot relative to its diagonal entry.
    Raises InputError when no shift helps: then M is not positive definite.
    """
    scale = (K_diagonal.abs() / M_diagonal).amax(-1)
    scale = torch.where(scale > 0, scale, 1.0)
    shift = torch.zeros_like(scale)
    factor, pivot = factorize(shift)
    size = FIRST_SHIFT
    while not bool((pivot > SAFE_PIVOT).all()):
        if size > 1e6:
            lane = int((~(pivot > SAFE_PIVOT)).nonzero()[0])
            where = lane_name(lane, len(scale))
            state = f"leaves K - sigma M indefinite down to {shift[lane]:.3g}"
            raise InputError("M", allowed="a positive definite matrix", noun=f"M{where}", state=state)
        shift = torch.where(pivot > SAFE_PIVOT, shift, -size * scale)
        size *= 10
        factor, pivot = factorize(shift)
    return shift, factor


def loses_digits(shift: Tensor, mu: Tensor) -> Tensor:
    """Return which shifts [lane] are so near the spectrum that digits are lost.

    These are all negative first shifts, and zero where the mu [lane, n] = 1 / (lambda - sigma) differ much in size: with
    several modes near zero, each pivot is rounding divided by the one before, and seems large enough.
    """
    return (shift < 0) | (mu[:, 0] > LOST * mu[:, -1])


def comparable_shift(near: Tensor, shift: Tensor, values: Tensor) -> Tensor:
    """Replace shifts that are `near` the spectrum: as far below the lowest of `values` [lane, n] as the highest is above."""
    span = torch.maximum(values[:, -1].abs(), values[:, 0].abs())
    below = values[:, 0].clamp_max(0.0) - torch.maximum(span, shift.abs())
    return torch.where(near, below, shift)
