"""What the vmap rules of torch.autograd.Function share.

Checked in tests/fem/reduction and tests/sensitivity.
"""

from __future__ import annotations

from torch import Tensor


def batch_first(x: Tensor, dim: int | None, size: int) -> Tensor:
    """Return x with its batch dimension of torch.func.vmap, `dim` of `in_dims`, in front; repeated where it has none."""
    return x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
