"""The inverse of small matrices whose entries have different units.

A stiffness of forces and moments has entries in N, N m and N m2. Scaled by its diagonal first, d A d with
d_i = 1 / sqrt(A_ii), it is inverted without loss of digits in the small entries; the scaling cancels exactly, so it is
a constant for derivatives. Positive diagonal assumed. Differentiable, forward and reverse, with lanes and under vmap.
Checked in tests/math/test_inverse.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def balanced_inverse(A: Float[Tensor, "*lanes n n"]) -> Float[Tensor, "*lanes n n"]:
    """A^-1 [..., n, n]."""
    d = A.detach().diagonal(dim1=-2, dim2=-1).rsqrt()
    scale = d[..., :, None] * d[..., None, :]
    return torch.linalg.inv(A * scale) * scale
