"""Padding of the modes of a batch: designs that retain fewer modes than others (cut.py).

    Kr = | K  0 |      Psi = ( psi  0 )
         | 0  0 |

Padding has no stiffness and no shape. In a motion it has unit mass, so it stays at zero and moves nothing. The functions here
keep it out of frequencies, inverses and starts.
Checked in tests/fem/reduction/test_padding.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def is_padding(Kr: Float[Tensor, "*lanes m m"]) -> Bool[Tensor, "*lanes m"]:
    """Which modal coordinates pad the others: a mode that is retained has a stiffness."""
    return Kr.detach().diagonal(dim1=-2, dim2=-1) == 0.0


def with_stiff_padding(Kr: Float[Tensor, "*lanes m m"]) -> Float[Tensor, "*lanes m m"]:
    """Kr with a stiffness of padding above all eigenvalues: these come first, in their order, and Kr is regular."""
    padding = is_padding(Kr).to(Kr.dtype)
    above = 2.0 * Kr.detach().diagonal(dim1=-2, dim2=-1).sum(-1)
    return Kr + torch.diag_embed(above[..., None] * padding)
